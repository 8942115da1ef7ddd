# SPDX-License-Identifier: GPL-3.0-or-later
"""Events of the worker, its progress, and the request to stop."""

from __future__ import annotations

import contextlib
import json
import signal
import sys
import threading
import time
from typing import Any


class Refused(Exception):
    """The environment cannot be made or used; the message is one plain sentence."""


class Stopped(Exception):
    """The user asked to stop."""


def emit(kind: str, **fields: Any) -> None:
    """Write one event."""
    sys.stdout.write(json.dumps({"type": kind, "time": round(time.time(), 3), **fields}) + "\n")
    sys.stdout.flush()


def print_error(line: str) -> None:
    """Write a line to stderr, where it becomes part of the log."""
    print(line, file=sys.stderr, flush=True)


class Progress:
    """Progress over stages, of which the usual seconds are known."""

    def __init__(self, stages: dict[str, float]) -> None:
        self.stages = stages
        self._stage = next(iter(stages))
        self._began = self._emitted = time.monotonic()
        self._fraction = 0.0

    def begin(self, stage: str, message: str) -> None:
        """Begin a stage, which completes those before; `message` describes it."""
        self._stage, self._began, self._fraction = stage, time.monotonic(), 0.0
        self.status(message)

    def status(self, message: str) -> None:
        """Describe another step of the stage."""
        emit("status", message=message)
        self._emit()

    def at(self, fraction: float) -> None:
        """Set the completed fraction of the stage, 0 to 1, which never decreases. Emitted at most twice a second."""
        self._fraction = max(self._fraction, min(fraction, 1.0))
        if time.monotonic() - self._emitted >= 0.5:
            self._emit()

    def _emit(self) -> None:
        now = self._emitted = time.monotonic()
        names = list(self.stages)
        before = sum(self.stages[name] for name in names[: names.index(self._stage)])
        usual, total, elapsed = self.stages[self._stage], sum(self.stages.values()), now - self._began
        # From the pace of the stage as soon as that is known, and from the usual seconds until then.
        fraction = self._fraction
        paced = elapsed * (1 - fraction) / fraction if fraction > 0.05 and elapsed > 3 else None
        left = usual * (1 - fraction) if paced is None else paced
        emit(
            "progress",
            done=round(before + usual * fraction, 2),
            total=total,
            seconds_left=round(left + total - before - usual, 1),
        )


class StopRequest:
    """Set by a line `stop`, by a signal, or by the end of the input after a line `attached`."""

    def __init__(self) -> None:
        self._event = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: self._event.set())
        threading.Thread(target=self._read, daemon=True).start()

    def __call__(self) -> bool:
        return self._event.is_set()

    def _read(self) -> None:
        attached = False
        with contextlib.suppress(OSError, ValueError):
            for line in sys.stdin:
                attached = attached or line.strip() == "attached"
                if line.strip() == "stop":
                    self._event.set()
        if attached:
            self._event.set()
