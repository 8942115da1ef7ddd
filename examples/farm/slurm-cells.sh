#!/bin/bash
# SPDX-License-Identifier: GPL-3.0-or-later
# A large capture on a cluster with SLURM: trains a coarse model, its cells as an array of jobs, and merges them.
#
#     examples/farm/slurm-cells.sh CAPTURE OUT CELLS COARSE_MINUTES CELL_MINUTES [option of sbatch ...]
#
# Run it in the folder of ObjectGS. PYTHON names the backend's Python (.venv/bin/python). The folders must be the same on
# all nodes, whose jobs need nothing of this shell's environment. A job that was stopped may be submitted again, and goes
# on.
set -euo pipefail

if [ "${1:-}" = "cell" ]; then
    exec "$2" -m backend train-cell "$3" --cell "$SLURM_ARRAY_TASK_ID" --minutes "$4"
fi

capture=$1 out=$2 cells=$3 coarse=$4 minutes=$5
shift 5
python=${PYTHON:-.venv/bin/python}

# Prints the number of the job, without the cluster that may follow it.
submit() {
    local id
    id=$(sbatch --parsable --chdir="$PWD" "$@")
    echo "${id%%;*}"
}

# Prints a command of the backend for any shell; the wrapped ones are run by sh.
backend() {
    local word
    for word in "$python" -m backend "$@"; do
        printf "'%s' " "${word//\'/\'\\\'\'}"
    done
}

train=$(submit "${@}" --job-name=objectgs-train --wrap \
    "$(backend train "$capture" --out "$out" --minutes "$coarse") && $(backend split "$out" --cells "$cells")")
array=$(submit "${@}" --job-name=objectgs-cell --dependency="afterok:$train" --array="0-$((cells - 1))" \
    "$0" cell "$python" "$out" "$minutes")
submit "${@}" --job-name=objectgs-merge --dependency="afterok:$array" --wrap "$(backend merge "$out")"
