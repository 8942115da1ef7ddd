"""Formatting of durations."""

from __future__ import annotations


def clock(seconds: float) -> str:
    """Format seconds as M:SS, or as H:MM:SS from one hour."""
    whole = round(max(seconds, 0.0))
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours}:{minutes:02d}:{whole % 60:02d}" if hours else f"{minutes}:{whole % 60:02d}"


def time_left(seconds: float) -> str:
    """Describe the estimated time until a job or step ends."""
    return f"{clock(seconds)} left"
