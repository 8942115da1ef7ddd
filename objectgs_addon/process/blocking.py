# SPDX-License-Identifier: GPL-3.0-or-later
"""Blocking execution of a job, for use without a timer."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Iterator
from types import FrameType

from ...backend.shared.durations import time_left
from ...backend.shared.errors import EXIT_BAD_INPUT, EXIT_CANCELLED, EXIT_DONE, EXIT_FAILED
from ...backend.shared.events import Reporter
from .jobs import Job, State


def run_blocking(job: Job, reporter: Reporter) -> int:
    """Run a job until it ends.

    SIGINT (Ctrl-C) or SIGTERM requests the job to save and stop; a second signal kills it.

    Args:
        job: a waiting job.
        reporter: receives messages, warnings and progress, and is closed. The caller must report an error, stored in
            `job.error`.

    Returns:
        The exit code: 0, 1, 2 or 130.
    """
    try:
        with _counted_signals() as signals:
            job.start(in_background=False)
            _watch(job, reporter, signals)
    finally:
        job.kill()
        reporter.close()
    if job.state is State.DONE:
        return EXIT_DONE
    if job.state is State.STOPPED:
        return EXIT_CANCELLED
    return EXIT_BAD_INPUT if job.exit_code in (EXIT_BAD_INPUT, None) else EXIT_FAILED


@contextlib.contextmanager
def _counted_signals() -> Iterator[list[int]]:
    """Yield a list of the signals received so far; outside the main thread, it stays empty."""
    arrived: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        arrived.append(number)

    is_main = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM) if is_main}
    try:
        yield arrived
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def _watch(job: Job, reporter: Reporter, signals: list[int]) -> None:
    """Poll the job until it ends, and report changes."""
    handled, reported, warned = 0, 0, 0
    told: tuple[float, str] | None = None
    while not job.is_finished:
        if len(signals) > handled:
            handled += 1
            job.stop() if handled == 1 else job.kill()
        job.poll()
        for message in job.statuses[reported:]:
            reporter.status(message)
        reported = len(job.statuses)
        for warning in job.warnings[warned:]:
            reporter.warning(warning)
        warned = len(job.warnings)
        left = "" if job.seconds_left is None else time_left(job.seconds_left)
        if job.progress and (job.progress, left) != told:
            told = job.progress, left
            reporter.progress(
                job.progress, 1.0, seconds_left=job.seconds_left, splats=job.splats, psnr=job.psnr, miou=job.miou,
                miou_all=job.miou_all, zero_is_background=job.zero_is_background,
            )  # fmt: skip
        time.sleep(0.02)
    if job.state is State.STOPPED or "message" in job.result:
        reporter.status(job.message)
