"""Requests to stop or pause a command, by signals or by lines on standard input from a controlling program."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from queue import SimpleQueue
from types import FrameType
from typing import Any

from .durations import awake_seconds
from .errors import Cancelled
from .events import Reporter
from .signals import STOPPING

Check = Callable[[], None]
"""What long work calls at intervals: it raises an exception if the work is to end, such as `Reporter.check`."""

_ASKED_EVERY = 0.1
"""Polling interval in seconds while paused."""


def proceed() -> None:
    """Check nothing, for work that nobody stops."""


class StopRequest:
    """A callable that returns whether to stop, and blocks while paused.

    It is set by an interrupt, by a termination signal, or by the lines `stop`, `pause` and `resume` on standard input.
    After the line `attached`, the end of standard input means that the controlling program has exited, and also stops.

    Args:
        announce: Called with a message when a pause begins and ends.

    Attributes:
        requests: Other lines of standard input that begin with `{`, for commands that answer requests.
        paused_seconds: Time for which calls have waited so far.
    """

    def __init__(self, announce: Callable[[str], None] = lambda _: None) -> None:
        self._announce = announce
        # Plain flags, since a signal handler that interrupts the main thread would deadlock on a lock that it holds.
        self._stopped = False
        self._paused = False
        self.requests: SimpleQueue[str] = SimpleQueue()
        self.paused_seconds = 0.0

    def __call__(self) -> bool:
        if self.paused:
            self._announce("Paused")
            began = awake_seconds()
            while self.paused:
                time.sleep(_ASKED_EVERY)
            self.paused_seconds += awake_seconds() - began
            if not self._stopped:
                self._announce("Resumed")
        return self._stopped

    @property
    def stopped(self) -> bool:
        """Whether a stop is requested; unlike a call, this does not wait."""
        return self._stopped

    @property
    def paused(self) -> bool:
        """Whether the next call waits."""
        return self._paused and not self._stopped

    @contextmanager
    def listening(self, read_stdin: bool) -> Iterator[None]:
        """Handle SIGINT and SIGTERM and, if `read_stdin`, the lines on standard input; restore the handlers at the end.

        A second signal raises KeyboardInterrupt immediately.
        """

        def on_signal(_number: int, _frame: FrameType | None) -> None:
            if self._stopped:
                raise KeyboardInterrupt
            self._stopped = True

        if read_stdin and sys.stdin is not None:
            threading.Thread(target=self._read, args=(_own_stdin(),), daemon=True).start()
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, on_signal) for number in STOPPING}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _read(self, lines: Iterable[str]) -> None:
        attached = False
        try:
            for line in lines:
                word = line.strip()
                if word == "stop":
                    self._stopped = True
                elif word in ("pause", "resume"):
                    self._paused = word == "pause"
                elif word == "attached":
                    attached = True
                elif word.startswith("{"):
                    self.requests.put(word)
        except (OSError, ValueError):
            pass  # Standard input is closed or unreadable.
        if attached:
            self._stopped = True


def take_stdin() -> int:
    """Return a descriptor of standard input, which from now on is empty for this process and those that it starts.

    While a thread waits for input, Windows lets everything else wait that only asks what kind of file the same pipe is,
    as programs and some libraries do at their start.
    """
    taken, nothing = os.dup(0), os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    return taken


def _own_stdin() -> Iterable[str]:
    """Return the lines of standard input, by `take_stdin` unless it was replaced."""
    return open(take_stdin(), encoding="utf-8", errors="replace") if sys.stdin is sys.__stdin__ else sys.stdin


class StoppingReporter(Reporter):
    """Forwards events; each progress event, and each check, waits while `stop` is paused, and raises Cancelled once a
    stop is requested.

    For work that only writes complete files and may therefore end between any two steps. Other work calls `stop` itself
    and reports to `reporter`, the wrapped reporter.
    """

    def __init__(self, reporter: Reporter, stop: StopRequest) -> None:
        self.reporter = reporter
        self.stop = stop

    def expect(self, parts: Mapping[str, tuple[str, float]]) -> None:
        self.reporter.expect(parts)

    def begin(self, part: str, message: str) -> None:
        self.reporter.begin(part, message)

    def status(self, message: str, **stage: Any) -> None:
        self.reporter.status(message, **stage)

    def progress(self, done: float, total: float, **fields: Any) -> None:
        self.reporter.progress(done, total, **fields)
        self.check()

    def check(self) -> None:
        if self.stop():
            raise Cancelled("Stopped; finished results are kept. Run the same command again to continue.")

    def preview(self, path: Path, **fields: Any) -> None:
        self.reporter.preview(path, **fields)

    def quality(self, **figures: Any) -> None:
        self.reporter.quality(**figures)

    def answer(self, **fields: Any) -> None:
        self.reporter.answer(**fields)

    def warning(self, message: str) -> None:
        self.reporter.warning(message)

    def error(self, message: str, **fields: Any) -> None:
        self.reporter.error(message, **fields)

    def stopped(self, message: str) -> None:
        self.reporter.stopped(message)

    def done(self, **fields: Any) -> None:
        self.reporter.done(**fields)

    def close(self) -> None:
        self.reporter.close()
