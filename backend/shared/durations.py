"""Measuring, estimating and formatting of durations."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping

_OVERDUE = 0.25
"""How long something that is overdue still takes, at least, relative to the time in which nothing was heard of it."""
_MOST = 0.99
"""Progress of a command whose parts are all complete, but which has not ended."""
_ANEW = 0.5
"""A part whose fraction falls by this factor has begun another pass, as over the photos."""
_EXPECTED = 0.05
"""Fraction of a part at which its pace tells as much of its duration as what was expected."""
_TYPICAL = 10.0
"""Expected seconds of complete parts from which on their pace tells more of later parts than what was expected."""
_SHORT = 5.0
"""Expected seconds up to which a part, such as reading, depends on the data more than on the computer."""
_FASTEST, _SLOWEST = 0.25, 8.0
"""Bounds of the factor by which later parts are taken to differ from what was expected."""
_UNKNOWN, _STILL_UNKNOWN, _UNKNOWN_SECONDS = 0.33, 0.5, 15.0
"""Largest fraction of the time left that may be of unknown pace for the estimate to be told, and to be told further on;
as many seconds always may."""


def awake_seconds() -> float:
    """Return a time in seconds from an unknown start that stands still while the computer sleeps.

    On Linux and macOS, `time.monotonic` does; on Windows it goes on.
    """
    if sys.platform == "win32":
        import ctypes

        ticks = ctypes.c_ulonglong()
        if ctypes.windll.kernel32.QueryUnbiasedInterruptTime(ctypes.byref(ticks)):
            return ticks.value / 1e7
    return time.monotonic()


def clock(seconds: float) -> str:
    """Format seconds as M:SS, or as H:MM:SS from one hour."""
    whole = round(max(seconds, 0.0))
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours}:{minutes:02d}:{whole % 60:02d}" if hours else f"{minutes}:{whole % 60:02d}"


_STEPS = ((600.0, 15), (3600.0, 60), (float("inf"), 300))
"""Up to which number of seconds an estimate is rounded to which step; it is not more exact than that."""


def time_left(seconds: float) -> str:
    """Describe the estimated time until a job or step ends."""
    if seconds < 60:
        return "less than a minute"
    step = next(step for until, step in _STEPS if seconds <= until)
    return f"{clock(step * round(seconds / step))} left"


def counted_down(seconds: float, passed: float) -> float:
    """Return what is left in seconds of an estimate, `passed` seconds later, if nothing was heard in the meantime.

    It falls with the clock, but not to zero: the longer the silence, the less plausible is an end at once.
    """
    return max(seconds - passed, _OVERDUE * passed)


class Limit(float):
    """Seconds that a part of a command takes on any computer, such as the time limit of a training."""


class Estimate:
    """Progress and time left of a command of several parts, some of which may not take place.

    `expect` tells how many seconds parts are expected to take, in the order in which they run, on a typical computer or
    as a `Limit`. A part's own estimate is what was expected at first, and follows its pace as its fraction grows. Later
    parts are scaled by how slow the complete ones, and the complete fraction of the current one, have proved compared
    with what was expected, those that were expected to take long most.

    Args:
        clock: Returns a time in seconds that stands still while the command is paused.

    Attributes:
        part: the current part, empty before the first one.
        progress: from 0 to 0.99, never decreasing. Each part has a share of the rest that is proportional to its
            estimated time, or more if the time spent and the time left, where it is known, say so.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._now = clock()
        self._seconds: dict[str, float] = {}
        self.part = ""
        self.progress = self._before = self._share = 0.0
        self._spent = self._typical = 0.0
        """Seconds that complete parts have taken, and were expected to take, as far as they count."""
        self._started = self._began = self._pass_began = self._moved = self._now
        self._fraction = self._expected = self._worth = 0.0
        self._reported: float | None = None
        self._is_told = False

    def expect(self, seconds: Mapping[str, float]) -> None:
        """Set the expected seconds of parts, also of those that have been expected before."""
        self._seconds.update(seconds)

    def begin(self, part: str) -> float | None:
        """Begin an expected part; the one before is complete, whether or not it was reported to be.

        Returns:
            As `advance`.
        """
        self._now = self._clock()
        if self._counts(self.part):
            self._spent += self._now - self._began
            self._typical += self._seconds[self.part]
        elif not self.part:
            self._started = self._now
        self.progress = self._before = max(self.progress, self._before + self._share)
        self.part, self._began = part, self._now
        self._begin_pass(0.0, 0.0)
        expected = self._scaled(part)
        self._begin_pass(expected, self._seconds[part])
        self._share = (_MOST - self._before) * expected / max(expected + self._later(), 1e-9)
        return self._estimate()

    def advance(self, fraction: float, reported: float | None = None) -> float | None:
        """Set the complete fraction of the current part, and what it says that it will still take, in seconds.

        Returns:
            The time left of the command in seconds; None as long as it is not known.
        """
        self._now = self._clock()
        if fraction < _ANEW * self._fraction:
            rest = max(1 - (self._now - self._pass_began) / max(self._expected, 1e-9), 0.0)
            self._begin_pass(rest * self._expected, rest * self._worth)
        if fraction != self._fraction:
            self._fraction, self._moved = fraction, self._now
        self._reported = reported
        return self._estimate()

    def _estimate(self) -> float | None:
        """Increase the progress, and return the time left, or None."""
        rest, unknown = self._rest()
        left = rest + self._later()
        unknown += self._doubt() * sum(self._scaled(part) for part in self._after() if self._counts(part))
        most = max((_STILL_UNKNOWN if self._is_told else _UNKNOWN) * left, _UNKNOWN_SECONDS)
        self._is_told = unknown <= most
        self.progress = max(self.progress, self._before + self._share * self._fraction)
        if not self._is_told:
            return None
        spent = self._now - self._started
        self.progress = max(self.progress, _MOST * spent / max(spent + left, 1e-9))
        return left

    def _begin_pass(self, expected: float, worth: float) -> None:
        """Begin a pass in the current part.

        Args:
            expected: Seconds that it is expected to take on this computer.
            worth: Seconds that it was expected to take.
        """
        self._expected, self._worth = expected, worth
        self._fraction, self._reported = 0.0, None
        self._pass_began = self._moved = self._now

    def _rest(self) -> tuple[float, float]:
        """Return the estimated seconds of the rest of the current part, and how many of them are not known."""
        if self._reported is not None:
            return self._reported, 0.0
        if isinstance(self._seconds[self.part], Limit):
            return counted_down(self._expected, self._now - self._pass_began), 0.0
        rest, silent = self._expected, self._now - self._moved
        if self._fraction:
            # As if a small fraction had been done before, in the time expected for it.
            spent = self._moved - self._pass_began + _EXPECTED * self._expected
            rest = spent * (1 - self._fraction) / (self._fraction + _EXPECTED)
        doubt = self._doubt() * _EXPECTED / (_EXPECTED + self._fraction)
        return counted_down(rest, silent), max(doubt * rest, silent - rest)

    def _later(self) -> float:
        """Return the estimated seconds of the parts after the current one."""
        return sum(map(self._scaled, self._after()))

    def _after(self) -> list[str]:
        names = list(self._seconds)
        return names[names.index(self.part) + 1 :]

    def _counts(self, part: str) -> bool:
        """Return whether the duration of a part tells something of other parts."""
        return self._seconds.get(part, 0.0) > _SHORT and not isinstance(self._seconds[part], Limit)

    def _scaled(self, part: str) -> float:
        """Return the estimated seconds of a part that has not begun."""
        seconds = self._seconds[part]
        if isinstance(seconds, Limit):
            return seconds
        spent, typical = self._evidence()
        return seconds * min(max((_TYPICAL + spent) / (_TYPICAL + typical), _FASTEST), _SLOWEST)

    def _evidence(self) -> tuple[float, float]:
        """Return the seconds spent on what is complete, and those that were expected for it."""
        if not self._counts(self.part):
            return self._spent, self._typical
        spent, done, silent = self._moved - self._pass_began, self._fraction, self._now - self._pass_began
        if not done and silent > self._expected:
            spent, done = silent, 1.0  # It takes at least as long as that.
        return self._spent + spent, self._typical + done * self._worth

    def _doubt(self) -> float:
        """Return how little is known of the pace of parts that have not begun, from 1, nothing, to 0."""
        return _TYPICAL / (_TYPICAL + self._evidence()[1])
