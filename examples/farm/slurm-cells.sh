#!/bin/bash
# SPDX-License-Identifier: GPL-3.0-or-later
# A large capture on a cluster with SLURM: trains a coarse model, its cells as an array of jobs, and merges them.
#
#     examples/farm/slurm-cells.sh CAPTURE OUT CELLS COARSE_MINUTES CELL_MINUTES [option of sbatch ...]
#
# Run it in the folder of ObjectGS. PYTHON names the backend's Python (.venv/bin/python). The folders must be the same on
# all nodes. A job that was stopped may be submitted again, and goes on.
set -euo pipefail

if [ "${1:-}" = "cell" ]; then
    exec "$PYTHON" -m backend train-cell "$2" --cell "$SLURM_ARRAY_TASK_ID" --minutes "$3"
fi

capture=$1 out=$2 cells=$3 coarse=$4 minutes=$5
shift 5
export PYTHON=${PYTHON:-.venv/bin/python}
submit() { sbatch --parsable --export=ALL --chdir="$PWD" "$@"; }

train=$(submit "${@}" --job-name=objectgs-train --wrap \
    "$(printf '%q ' "$PYTHON" -m backend train "$capture" --out "$out" --minutes "$coarse") && \
     $(printf '%q ' "$PYTHON" -m backend split "$out" --cells "$cells")")
array=$(submit "${@}" --job-name=objectgs-cell --dependency="afterok:$train" --array="0-$((cells - 1))" \
    "$0" cell "$out" "$minutes")
submit "${@}" --job-name=objectgs-merge --dependency="afterok:$array" --wrap \
    "$(printf '%q ' "$PYTHON" -m backend merge "$out")"
