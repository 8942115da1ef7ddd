"""Stages of COLMAP in child processes: progress, pause, and a stop that leaves what is in the database."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import psutil
from numba import get_num_threads

from ..shared.errors import Cancelled, InputError
from ..shared.stopping import StoppingReporter

_ROOT = Path(__file__).resolve().parents[2]
_POLLED_EVERY = 0.3
_KILLED = (-9, 137)
_STOPPED = "Stopped; features and matches are kept. Run the same command again to continue."


def run_stage(
    reporter: StoppingReporter, log: Path, arguments: list[str], count: Callable[[int], int], total: int
) -> bool:
    """Run a stage of `backend.sfm.worker`, with as many threads as kernels have, until it ends.

    Args:
        reporter: receives progress; its request to pause suspends the process, and that to stop ends it.
        log: file to which COLMAP's messages are appended.
        arguments: name of the stage, and its arguments.
        count: called with the number of lines that the process has printed; returns how much of `total` is done.
        total: number at which the stage is complete.

    Returns:
        Whether it succeeded. A mapping fails if the photos do not fit together.

    Raises:
        Cancelled: the user has stopped it.
        InputError: the process was ended by the system.
    """
    lines = 0

    def read(stream) -> None:  # type: ignore[no-untyped-def]
        nonlocal lines
        for _ in stream:
            lines += 1

    with log.open("ab") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "backend.sfm.worker", str(get_num_threads()), *arguments],
            cwd=_ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors,
        )  # fmt: skip
        reading = threading.Thread(target=read, args=(process.stdout,), daemon=True)
        reading.start()
        try:
            while True:
                try:
                    process.wait(_POLLED_EVERY)
                    break
                except subprocess.TimeoutExpired:
                    _wait_while_paused(process, reporter)
                    reporter.progress(min(count(lines), total), max(total, 1))
        except BaseException:
            process.kill()
            raise
        finally:
            process.wait()
            reading.join()
            assert process.stdin is not None
            process.stdin.close()
    if process.returncode and reporter.stop():
        raise Cancelled(_STOPPED)  # An interrupt from the keyboard has reached the process first.
    if process.returncode in _KILLED:
        raise InputError(
            f"The system ended the stage {arguments[0]}, as happens when memory runs out; close other programs, or use "
            "fewer photos. The same command continues."
        )
    return process.returncode == 0


def _wait_while_paused(process: subprocess.Popen, reporter: StoppingReporter) -> None:
    """Suspend the process while the user has paused; raises Cancelled if the user has stopped it."""
    if not reporter.stop.paused:
        if reporter.stop():
            raise Cancelled(_STOPPED)
        return
    paused = []
    with suppress(psutil.NoSuchProcess):
        child = psutil.Process(process.pid)
        # On Windows, the python.exe of an environment starts the real one.
        for each in (child, *child.children(recursive=True)):
            with suppress(psutil.NoSuchProcess):
                each.suspend()
                paused.append(each)
    try:
        reporter.stop()  # Returns when the pause ends.
    finally:
        for each in paused:
            with suppress(psutil.NoSuchProcess):
                each.resume()
