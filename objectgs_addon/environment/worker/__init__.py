# SPDX-License-Identifier: GPL-3.0-or-later
"""Program that creates the backend's environment, or checks whether a Python has the backend's packages.

    BASE_PYTHON worker/ setup --folder FOLDER --requirements DIR --device cpu|cuda
    PYTHON worker/ probe --requirements DIR

The program uses only the standard library. The Python to set up or check runs it, in the folder that contains backend/.
Blender imports only `layout`. The protocol is that of the backend: the program writes events as JSON lines and reads
the lines `attached` and `stop`. Exit codes: 0 done, 2 refused with a message, 130 stopped, 1 any other failure.

FOLDER contains a stamp, which marks it as created by this program, venv/, tmp/ during downloads, and the marker
ready.json. The marker is written last; without it, the environment is incomplete. A setup that fails or is stopped
removes its files.
"""
