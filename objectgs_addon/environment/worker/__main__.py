# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs the worker by its path, in a process of its own."""

import sys
from pathlib import Path

# The folder that contains this package, in place of this folder, which Python puts there.
sys.path[0] = str(Path(__file__).resolve().parents[1])

from worker.command_line import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
