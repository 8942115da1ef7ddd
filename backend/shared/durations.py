"""Durations as people read them."""

from __future__ import annotations


def clock(seconds: float) -> str:
    """Seconds as M:SS, or H:MM:SS from an hour on."""
    whole = round(max(seconds, 0.0))
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours}:{minutes:02d}:{whole % 60:02d}" if hours else f"{minutes}:{whole % 60:02d}"
