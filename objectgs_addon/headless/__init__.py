# SPDX-License-Identifier: GPL-3.0-or-later
"""Commands of headless.py, for use without a window."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import sys
import traceback
from collections.abc import Iterator
from typing import Any

from ...backend.shared.console import ConsoleReporter
from ...backend.shared.errors import EXIT_BAD_INPUT, EXIT_CANCELLED, EXIT_DONE, EXIT_FAILED, Cancelled, InputError
from ...backend.shared.events import JsonReporter, Reporter
from . import batch, commands, filming, meshes
from .arguments import UsageError, parse

COMMANDS = {
    "demo": commands.demo,
    "import": commands.backend,
    "plan": commands.plan,
    "vote": commands.backend,
    "train": commands.backend,
    "mesh": commands.on_result,
    "edit": commands.on_result,
    "export": commands.on_result,
    "export-meshes": meshes.export_meshes,
    "import-splats": commands.import_splats,
    "build": commands.build,
    "render": commands.render,
    "film": filming.film,
    "run": commands.run,
    "batch": batch.batch,
}


def main(arguments: list[str]) -> int:
    """Run one command line and return the exit code."""
    _prepare_streams()
    reporter: Reporter = JsonReporter() if "--json" in arguments else ConsoleReporter()
    try:
        options = parse(arguments)
        options.reporter = reporter
        with _stoppable():
            COMMANDS[options.command](options)
        reporter.done()
        return EXIT_DONE
    except (KeyboardInterrupt, Cancelled) as error:
        reporter.stopped(str(error) or "Cancelled.")
        return EXIT_CANCELLED
    except (InputError, UsageError) as error:
        reporter.error(str(error))
        return EXIT_BAD_INPUT
    except BrokenPipeError:
        # The reader has closed the pipe. Replace stdout, since Python flushes it again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_CANCELLED
    except commands.StepFailed as error:
        reporter.error(str(error))
        return EXIT_FAILED
    except Exception as error:
        if isinstance(error, OSError) and error.filename:
            reporter.error(commands.sentence(error))
            return EXIT_BAD_INPUT
        traceback.print_exc()
        reporter.error(f"Unexpected error: {type(error).__name__}: {' '.join(str(error).split())}")
        return EXIT_FAILED


def _prepare_streams() -> None:
    """Let the output streams escape characters that their encoding does not have, as in files on Windows."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


@contextlib.contextmanager
def _stoppable() -> Iterator[None]:
    """Raise KeyboardInterrupt on SIGINT, which Blender would handle itself, and on SIGTERM, which would end Blender.

    SIGPIPE is ignored, so that a closed pipe raises BrokenPipeError as in plain Python instead of ending Blender.
    """

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    wanted: dict[int, Any] = {signal.SIGINT: stop, signal.SIGTERM: stop}
    if hasattr(signal, "SIGPIPE"):
        wanted[signal.SIGPIPE] = signal.SIG_IGN
    before = {number: signal.signal(number, handler) for number, handler in wanted.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)
