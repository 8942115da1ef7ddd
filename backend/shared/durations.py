"""Measuring and formatting of durations."""

from __future__ import annotations

import sys
import time


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


_STEPS = ((60.0, 5), (600.0, 15), (3600.0, 60), (float("inf"), 300))
"""Up to which number of seconds an estimate is rounded to which step; it is not more exact than that."""


def time_left(seconds: float) -> str:
    """Describe the estimated time until a job or step ends."""
    step = next(step for until, step in _STEPS if seconds <= until)
    return f"{clock(max(step * round(seconds / step), step))} left"
