#!/bin/bash
# SPDX-License-Identifier: GPL-3.0-or-later
# A folder of captures on a cluster with SLURM: trains, meshes and measures each, as an array of jobs.
#
#     examples/farm/slurm-captures.sh FOLDER OUT MINUTES [option of sbatch ...]
#
# The captures are the subfolders of FOLDER with images/ or sparse/; their reconstructions in OUT have the same names.
# Run it in the folder of ObjectGS. PYTHON names the backend's Python (.venv/bin/python). The folders must be the same on
# all nodes, whose jobs need nothing of this shell's environment. A job that was stopped may be submitted again, and goes
# on.
set -euo pipefail

# Whether `mesh` has tried every object.
is_meshed() {
    [ -f "$1/meshes/meshes.json" ] && ! grep -q '"waiting": \[' "$1/meshes/meshes.json"
}

if [ "${1:-}" = "--element" ]; then
    python=$2 out=$3 minutes=$4
    shift 4
    capture=${*:SLURM_ARRAY_TASK_ID + 1:1}
    out=$out/${capture##*/}
    "$python" -m backend train "$capture" --out "$out" --minutes "$minutes"
    code=0
    "$python" -m backend mesh "$out" || code=$?
    # Without a surface, no object has a mesh; the splats are measured all the same.
    if [ $code != 0 ] && ! { [ $code = 2 ] && is_meshed "$out"; }; then
        exit $code
    fi
    # `evaluate` refuses captures that hold out no view.
    if grep -q '"held_out": true' "$out/cameras.json"; then
        "$python" -m backend evaluate "$out"
    fi
    exec "$python" -m backend report "$out"
fi

folder=$1 out=$2 minutes=$3
shift 3

captures=()
for capture in "${folder%/}"/*/; do
    if [ -d "$capture/images" ] || [ -d "$capture/sparse" ]; then
        captures+=("${capture%/}")
    fi
done
if [ ${#captures[@]} = 0 ]; then
    echo "No subfolder of $folder has images/ or sparse/." >&2
    exit 1
fi

# The jobs get the names, so that each has its capture even if others are added to the folder.
sbatch "${@}" --chdir="$PWD" --job-name=objectgs-captures --array="0-$((${#captures[@]} - 1))" \
    "$0" --element "${PYTHON:-.venv/bin/python}" "$out" "$minutes" "${captures[@]}"
