"""Asking a command to stop: by a signal, or by a line from the program that runs it."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager


class StopRequest:
    """Set by an interrupt, a termination signal, or a line `stop` on standard input; asked by calling it."""

    def __init__(self) -> None:
        self._event = threading.Event()

    def __call__(self) -> bool:
        return self._event.is_set()

    @contextmanager
    def listening(self, read_stdin: bool) -> Iterator[None]:
        """Take over the signals, and standard input where another program drives this one.

        A second signal interrupts at once, whatever is being done.
        """

        def on_signal(number, frame):
            if self._event.is_set():
                raise KeyboardInterrupt
            self._event.set()

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
        try:
            for line in sys.stdin:
                if line.strip() == "stop":
                    self._event.set()
        except (OSError, ValueError):
            pass  # Closed, or not to be read: then nothing can be asked there.
