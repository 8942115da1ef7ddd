"""Runs one command line and converts errors to exit codes; the commands are in `backend.commands`."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Sequence

from ..shared.console import ConsoleReporter
from ..shared.errors import (
    EXIT_BAD_INPUT,
    EXIT_CANCELLED,
    EXIT_DONE,
    EXIT_FAILED,
    Cancelled,
    InputError,
    describe_missing_package,
)
from ..shared.events import JsonReporter, Reporter
from ..shared.stopping import StoppingReporter, StopRequest
from .kernel_cache import use_private_cache
from .parser import UsageError, build_parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: The command line without the program's name; None for this process's.

    Returns:
        The exit code: `EXIT_DONE`, `EXIT_BAD_INPUT`, `EXIT_CANCELLED` or `EXIT_FAILED`.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    reporter = _reporter(as_json="--json" in arguments)
    try:
        return _run(arguments, reporter)
    except BrokenPipeError:
        # The reader has closed the pipe. Otherwise Python would fail again when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_CANCELLED
    finally:
        reporter.close()


def _run(arguments: list[str], reporter: Reporter) -> int:
    stop = StopRequest(announce=reporter.status)
    try:
        options = build_parser().parse_args(arguments)
        refused = use_private_cache()
        if refused:
            reporter.warning(refused)
        # Before signals are handled, since pycolmap installs its own SIGTERM handler when it is imported.
        from ..commands import COMMANDS
        from ..commands.setup.machine import set_threads

        with stop.listening(read_stdin=options.json):
            set_threads(options.threads)
            COMMANDS[options.command](options, StoppingReporter(reporter, stop))
        return EXIT_DONE
    except (InputError, UsageError) as error:
        reporter.error(str(error))
        return EXIT_BAD_INPUT
    except (Cancelled, KeyboardInterrupt) as error:
        reporter.stopped(str(error) or "Stopped immediately.")
        return EXIT_CANCELLED
    except BrokenPipeError:
        raise
    except Exception as error:
        sentence = _describe_error(error)
        if sentence:
            reporter.error(sentence)
            return EXIT_BAD_INPUT
        import traceback

        traceback.print_exc(file=sys.stderr)
        reporter.error(f"Unexpected error: {type(error).__name__}: {' '.join(str(error).split())}")
        return EXIT_FAILED


def _reporter(as_json: bool) -> Reporter:
    return JsonReporter() if as_json else ConsoleReporter()


def _describe_error(error: Exception) -> str | None:
    """Return a sentence for errors due to missing memory, packages or files; None for all other errors."""
    from ..raster.devices import is_out_of_memory

    if is_out_of_memory(error):
        return (
            "The GPU's memory is full; close programs that use it, or try a smaller --max-size or --max-anchors, or "
            "--device cpu. The same command resumes from the last checkpoint."
        )
    # torch reports a lack of memory with a RuntimeError.
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "allocate memory" in str(error)):
        return "There is not enough memory; try a smaller --max-size, --memory-mb or --max-anchors."
    if isinstance(error, ModuleNotFoundError):
        return describe_missing_package(error)
    if isinstance(error, OSError) and error.filename:
        full = error.errno in (errno.ENOSPC, getattr(errno, "EDQUOT", None))
        problem = "could not be written" if full else "cannot be used"
        advice = "free some space and run the same command again" if full else "check it and its permissions"
        return f"{error.filename} {problem} ({error.strerror}); {advice}."
    return None
