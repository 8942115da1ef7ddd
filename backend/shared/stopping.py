"""Asking a command to stop or to wait: by a signal, or by lines from the program that drives it."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from .errors import Cancelled
from .events import Reporter

_ASKED_EVERY = 0.1
"""Seconds between two looks, while paused, at whether to go on."""


class StopRequest:
    """Asked by calling it: whether to stop. While paused the call does not return.

    Set by an interrupt, a termination signal, or lines on standard input: `stop`, `pause`, `resume`, and `attached`,
    after which the end of standard input means that the driving program is gone, which stops too.
    `announce` is told when a pause begins and ends.
    """

    def __init__(self, announce: Callable[[str], None] = lambda _: None) -> None:
        self._announce = announce
        # Plain flags: a lock that the main thread holds could not be taken by a signal handler, which interrupts it.
        self._stopped = False
        self._paused = False

    def __call__(self) -> bool:
        if self.paused:
            self._announce("Paused")
            while self.paused:
                time.sleep(_ASKED_EVERY)
            if not self._stopped:
                self._announce("Going on")
        return self._stopped

    @property
    def paused(self) -> bool:
        """Whether the next call waits."""
        return self._paused and not self._stopped

    @contextmanager
    def listening(self, read_stdin: bool) -> Iterator[None]:
        """Take over the signals, and standard input where another program drives this one.

        A second signal interrupts at once, whatever is being done.
        """

        def on_signal(_number: int, _frame: FrameType | None) -> None:
            if self._stopped:
                raise KeyboardInterrupt
            self._stopped = True

        if read_stdin and sys.stdin is not None:
            threading.Thread(target=self._read, daemon=True).start()
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _read(self) -> None:
        attached = False
        try:
            for line in sys.stdin:
                word = line.strip()
                if word == "stop":
                    self._stopped = True
                elif word in ("pause", "resume"):
                    self._paused = word == "pause"
                elif word == "attached":
                    attached = True
        except (OSError, ValueError):
            pass  # Closed, or not to be read: then nothing can be asked there.
        if attached:
            self._stopped = True


class StoppingReporter(Reporter):
    """Hands events on; at each progress it waits while `stop` is paused, and raises Cancelled where it says so.

    For work that writes whole files alone and so may end between any two of its steps. Other work asks `stop` itself
    and tells `reporter`, the one behind.
    """

    def __init__(self, reporter: Reporter, stop: StopRequest) -> None:
        self.reporter = reporter
        self.stop = stop

    def status(self, message: str) -> None:
        self.reporter.status(message)

    def progress(self, done: float, total: float, **fields: Any) -> None:
        self.reporter.progress(done, total, **fields)
        if self.stop():
            raise Cancelled("Stopped; what is finished is kept, run the same command again for the rest.")

    def preview(self, path: Path, **fields: Any) -> None:
        self.reporter.preview(path, **fields)

    def quality(self, **figures: Any) -> None:
        self.reporter.quality(**figures)

    def warning(self, message: str) -> None:
        self.reporter.warning(message)

    def error(self, message: str) -> None:
        self.reporter.error(message)

    def stopped(self, message: str) -> None:
        self.reporter.stopped(message)

    def done(self, **fields: Any) -> None:
        self.reporter.done(**fields)

    def close(self) -> None:
        self.reporter.close()
