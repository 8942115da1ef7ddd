# SPDX-License-Identifier: GPL-3.0-or-later
"""Entry point to run the worker by its path, in a separate process."""

import sys
from pathlib import Path

# Replace this folder, which Python puts here, with its parent, from which the package can be imported.
sys.path[0] = str(Path(__file__).resolve().parents[1])

from worker.command_line import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
