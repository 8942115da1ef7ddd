# SPDX-License-Identifier: GPL-3.0-or-later
"""Command line of the worker."""

from __future__ import annotations

import argparse
import traceback
from pathlib import Path

from .additions import add
from .checks import probe
from .events import Refused, Stopped, StopRequest, emit
from .layout import MARKER
from .setup import set_up


def main() -> int:
    """Run the command line and return the exit code."""
    parser = argparse.ArgumentParser(prog="worker", description="Make or check the environment of ObjectGS's backend.")
    commands = parser.add_subparsers(dest="command", required=True)
    setup = commands.add_parser("setup", help="make an environment")
    setup.add_argument("--folder", type=Path, required=True, help="its folder: new, empty or an earlier environment")
    setup.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    check = commands.add_parser("probe", help="check this Python")
    more = commands.add_parser("add", help="install the packages for models in this Python")
    for command in (setup, check, more):
        command.add_argument(
            "--requirements", type=Path, required=True, help="folder of torch.txt, backend.txt and models.txt"
        )
    options = parser.parse_args()
    try:
        {"setup": set_up, "probe": probe, "add": add}[options.command](options, StopRequest())
        return 0
    except Refused as refusal:
        emit("error", message=str(refusal))
        return 2
    except Stopped:
        what = "nothing was changed"
        if options.command == "setup":
            is_kept = (options.folder / MARKER).exists()
            what = "the earlier environment is kept" if is_kept else "nothing of the environment is kept"
        emit("done", stopped=True, message=f"Stopped; {what}.")
        return 130
    except OSError as error:
        emit(
            "error",
            message=f"{error.filename or 'A file'} cannot be used ({error.strerror or error}); free it, or "
            "make room, and try again.",
        )
        return 2
    except Exception as error:
        traceback.print_exc()
        emit("error", message=f"Unexpected error: {type(error).__name__}: {' '.join(str(error).split())}")
        return 1
