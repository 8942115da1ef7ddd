# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes the backend's environment, or checks whether a Python has the packages of the backend.

    BASE_PYTHON worker/ setup --folder FOLDER --requirements DIR --device cpu|cuda
    PYTHON worker/ probe --requirements DIR

This folder is a program of the standard library alone, run by the Python in question in the folder that contains
backend/. Blender imports `layout` from it. The program has the events of the backend: JSON lines out, `attached` and
`stop` in; exit codes 0 done, 2 refused with a sentence, 130 stopped, 1 any other failure.

FOLDER contains a stamp that marks it as ours, venv/, tmp/ while packages are downloaded, and ready.json, which is
written last: without it nothing is installed. A set-up that fails or is stopped removes what it has made.
"""
