# SPDX-License-Identifier: GPL-3.0-or-later
"""Events and progress of the worker, and the request to stop."""

from __future__ import annotations

import contextlib
import json
import signal
import sys
import threading
import time
from typing import Any


class Refused(Exception):
    """The environment cannot be created or used; the message is one plain sentence."""


class Stopped(Exception):
    """The user requested a stop."""


def emit(kind: str, **fields: Any) -> None:
    """Write one event to stdout as a JSON line."""
    sys.stdout.write(json.dumps({"type": kind, "time": round(time.time(), 3), **fields}) + "\n")
    sys.stdout.flush()


def print_error(line: str) -> None:
    """Write a line to stderr, which Blender adds to the job's log."""
    print(line, file=sys.stderr, flush=True)


class Progress:
    """Progress over parts: `parts` maps their names to the stage that the user sees and a typical duration in s."""

    def __init__(self, parts: dict[str, tuple[str, float]]) -> None:
        self._parts = parts
        self._part = next(iter(parts))
        self._began = self._emitted = time.monotonic()
        self._fraction = 0.0

    def begin(self, part: str, message: str) -> None:
        """Begin a part, described by `message`; the earlier parts are complete."""
        self._part, self._began, self._fraction = part, time.monotonic(), 0.0
        self.status(message)

    def status(self, message: str) -> None:
        """Report a new step of the part."""
        names, stage = list(dict.fromkeys(name for name, _ in self._parts.values())), self._parts[self._part][0]
        place = {"stage": stage, "number": names.index(stage) + 1, "of": len(names)} if len(names) > 1 else {}
        emit("status", message=message, **place)
        self._emit()

    def at(self, fraction: float) -> None:
        """Set the completed fraction of the part, from 0 to 1; it never decreases. Emit at most twice per second."""
        self._fraction = max(self._fraction, min(fraction, 1.0))
        if time.monotonic() - self._emitted >= 0.5:
            self._emit()

    def _emit(self) -> None:
        now = self._emitted = time.monotonic()
        names, seconds = list(self._parts), [usual for _, usual in self._parts.values()]
        place = names.index(self._part)
        before, usual, total, elapsed = sum(seconds[:place]), seconds[place], sum(seconds), now - self._began
        fraction, left = self._fraction, max(usual - elapsed, elapsed / 4)
        if fraction:
            # As if a twentieth had been done before in the usual time, so that the pace tells more and more.
            left = (elapsed + usual / 20) * (1 - fraction) / (fraction + 1 / 20)
        emit(
            "progress",
            done=round(before + usual * fraction, 2),
            total=total,
            seconds_left=round(left + total - before - usual, 1),
        )


class StopRequest:
    """Request to stop: the line `stop`, SIGINT, SIGTERM, or the end of the input after the line `attached`."""

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
