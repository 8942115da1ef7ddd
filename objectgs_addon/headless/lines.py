# SPDX-License-Identifier: GPL-3.0-or-later
"""Events as lines for whoever watches a terminal or reads a log."""

import sys
import time

from ...backend.protocol import Reporter

_SECONDS_BETWEEN_LINES = 5.0


def say(line: str) -> None:
    """One line, at once."""
    print(line, flush=True)


class LineReporter(Reporter):
    """Prints what is done and, every few seconds, how far it is; how it failed goes to stderr."""

    def __init__(self) -> None:
        self._last = time.monotonic()

    def status(self, message):
        say(message)

    def progress(self, done, total, **fields):
        now = time.monotonic()
        if now - self._last >= _SECONDS_BETWEEN_LINES:
            self._last = now
            left = fields.get("seconds_left")
            say(f"  {done} of {total}" + (f", {left:.0f} s left" if left is not None else ""))

    def warning(self, message):
        say(f"Warning: {message}")

    def error(self, message):
        print(message, file=sys.stderr, flush=True)

    def stopped(self, message):
        print(message, file=sys.stderr, flush=True)
