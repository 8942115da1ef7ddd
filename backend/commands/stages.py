"""Timing of the stages of a command, recorded in objectgs.json."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from ..shared.reconstruction.folder import Reconstruction
from ..shared.reconstruction.record import StageRecord, record_stage
from .setup.machine import peak_mb


@contextmanager
def stage(folder: Reconstruction, name: str) -> Iterator[None]:
    """Measure a stage and record its figures when it has completed."""
    started = time.monotonic()
    yield
    finish_stage(folder, name, time.monotonic() - started)


def finish_stage(folder: Reconstruction, name: str, seconds: float) -> None:
    """Record a stage that took `seconds`, with this process's peak memory so far."""
    record_stage(folder, StageRecord(name, round(seconds, 2), peak_mb()))
