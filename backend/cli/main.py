"""Runs one command line and converts errors to exit codes; the commands are in `backend.commands`."""

from __future__ import annotations

import argparse
import errno
import functools
import io
import os
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TextIO

from ..shared.console import ConsoleReporter
from ..shared.durations import awake_seconds
from ..shared.errors import (
    EXIT_BAD_INPUT,
    EXIT_CANCELLED,
    EXIT_DONE,
    EXIT_FAILED,
    Cancelled,
    InputError,
    ProcessLost,
    describe_missing_package,
    is_lack_of_memory,
    is_lack_of_space,
)
from ..shared.events import JsonReporter, Reporter, StagedReporter
from ..shared.signals import held_signals
from ..shared.stopping import StoppingReporter, StopRequest
from .kernel_cache import use_private_cache
from .parser import UsageError, build_parser

_OUTPUT_ERRORS = (errno.EPIPE, errno.ENOSPC, errno.EIO, errno.EBADF, errno.EFBIG)
_LONGEST = 1000
"""Number of characters of an error message; names and paths in it may be longer."""
_RESTART = "--restart"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: The command line without the program's name; None for this process's.

    Returns:
        The exit code: `EXIT_DONE`, `EXIT_BAD_INPUT`, `EXIT_CANCELLED` or `EXIT_FAILED`.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    _prepare_streams()
    reporter = _reporter(as_json="--json" in arguments)
    try:
        code = _run(arguments, reporter)
        reporter.close()
        return code
    except BrokenPipeError:
        # The reader has closed the pipe.
        _discard(sys.stdout)
        return EXIT_CANCELLED
    except OSError as error:
        _discard(sys.stdout)
        with suppress(OSError):
            print(f"error: The output could not be written ({error.strerror}).", file=sys.stderr, flush=True)
            return EXIT_FAILED
        _discard(sys.stderr)
        return EXIT_FAILED


def _prepare_streams() -> None:
    """Replace closed output streams, and let the others escape characters that their encoding does not have."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _tell(report: Callable[[str], None], sentence: str) -> None:
    """Report how a command ended; if that cannot be written, the exit code alone says it."""
    try:
        report(sentence)
    except OSError:
        _discard(sys.stdout)
        _discard(sys.stderr)


def _discard(stream: TextIO) -> None:
    """Discard the rest of a stream's output. Otherwise Python would fail again when it flushes it at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _run(arguments: list[str], reporter: Reporter) -> int:
    stop = StopRequest(announce=reporter.status)
    options: argparse.Namespace | None = None
    try:
        options = build_parser().parse_args(arguments)
        if refused := use_private_cache():
            reporter.warning(refused)
        with ExitStack() as stack:
            with held_signals():
                # Before signals are handled, since pycolmap installs its own SIGTERM handler when it is imported.
                from ..commands import command_of
                from ..commands.setup.machine import owns_stdin, set_threads

                run = command_of(options.command)
                stack.enter_context(stop.listening(read_stdin=options.json and owns_stdin()))
            set_threads(options.threads)
            staged = StagedReporter(reporter, lambda: awake_seconds() - stop.paused_seconds)
            run(options, StoppingReporter(staged, stop))
        return EXIT_DONE
    except (InputError, UsageError) as error:
        fields = error.fields if isinstance(error, InputError) else {}
        _tell(functools.partial(reporter.error, **fields), _shortened(str(error)))
        return EXIT_BAD_INPUT
    except (Cancelled, KeyboardInterrupt) as error:
        _tell(reporter.stopped, _without_restart(str(error) or "Stopped immediately.", arguments, options))
        return EXIT_CANCELLED
    except ProcessLost as error:
        _tell(reporter.error, _without_restart(str(error), arguments, options))
        return EXIT_FAILED
    except Exception as error:
        if isinstance(error, OSError) and error.filename is None and error.errno in _OUTPUT_ERRORS:
            raise  # Files are written with their names in the error, so this is a stream.
        sentence = _describe_error(error, trains=hasattr(options, "max_anchors"))
        if sentence:
            _tell(reporter.error, _without_restart(_shortened(sentence), arguments, options))
            return EXIT_BAD_INPUT
        import traceback

        traceback.print_exc(file=sys.stderr)
        _tell(reporter.error, _shortened(f"Unexpected error: {type(error).__name__}: {error}"))
        return EXIT_FAILED


def _without_restart(sentence: str, arguments: list[str], options: argparse.Namespace | None) -> str:
    """Return a message about what the same command continues, for a command that would discard it by its --restart.

    Commands clear this option once they have begun anew.
    """
    if _RESTART not in arguments or options is None or options.restart:
        return sentence
    return re.sub("(same command( again)?)", rf"\1 without {_RESTART}", sentence)


def _reporter(as_json: bool) -> Reporter:
    return JsonReporter() if as_json else ConsoleReporter()


def _shortened(sentence: str) -> str:
    """Return a sentence without the middle of what the user's input has made longer than `_LONGEST`, on one line."""
    sentence = " ".join(sentence.split())
    half = _LONGEST // 2
    return sentence if len(sentence) <= _LONGEST else f"{sentence[:half]} ... {sentence[-half:]}"


def _describe_error(error: Exception, trains: bool) -> str | None:
    """Return a sentence for errors due to missing memory, packages or files; None for all other errors."""
    try:
        from ..raster.devices import is_failure, is_out_of_memory

        is_gpu_full, has_gpu_failed = is_out_of_memory(error), is_failure(error)
    except (ImportError, OSError):
        # The error may be that torch cannot be loaded.
        is_gpu_full = has_gpu_failed = False
    if is_gpu_full and not trains:
        return "The GPU's memory is full; close programs that use it, or use --device cpu."
    if is_gpu_full:
        return (
            "The GPU's memory is full; close programs that use it, or try a smaller --max-size or --max-anchors, or "
            "--device cpu. The same command resumes from the last checkpoint."
        )
    if has_gpu_failed:
        first = str(error).strip().partition("\n")[0].rstrip(".")
        return (
            f"The GPU failed ({first}); the same command resumes from the last checkpoint, with --device cpu on the "
            "CPU; `doctor` tests the GPU."
        )
    if is_lack_of_memory(error):
        return "There is not enough memory; try a smaller --max-size, --memory-mb or --max-anchors."
    if isinstance(error, ModuleNotFoundError):
        return describe_missing_package(error)
    if isinstance(error, OSError) and error.filename:
        parent = Path(str(error.filename)).parent
        if error.errno == errno.ENOENT and not parent.is_dir():
            return (
                f"{error.filename} cannot be used, since the folder {parent} does not exist; connect its disk or "
                "create it."
            )
        full = is_lack_of_space(error)
        problem = "could not be written" if full else "cannot be used"
        advice = "free some space and run the same command again" if full else "check it and its permissions"
        return f"{error.filename} {problem} ({error.strerror}); {advice}."
    return None
