"""objectgs.json: what was asked, so that a later command knows what the files beside it were made from.

`capture` (folder, max_size, digest), `votes` (what points.ply came from), `training` (settings, minutes or steps, the
IDs that were left out, the votes it began with, the plan), `export` (how much splats.ply and anchors.ply hold) and
`stages` (seconds and peak memory).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from .. import __version__
from ..protocol import InputError, Reconstruction, read_json, write_json
from .machine import peak_mb


def recorded(folder: Reconstruction) -> dict[str, Any]:
    """What objectgs.json holds; empty where there is none."""
    if not folder.settings.exists():
        return {}
    memory = read_json(folder.settings)
    if not isinstance(memory, dict):
        raise InputError(f"{folder.settings} was not written by this program; choose another folder.")
    return memory


def record(folder: Reconstruction, **values: Any) -> None:
    """Merge into objectgs.json."""
    write_json(folder.settings, {**recorded(folder), "version": __version__, **values})


@contextmanager
def stage(folder: Reconstruction, name: str) -> Iterator[None]:
    """Measure a stage and keep its figures in objectgs.json once it is done."""
    started = time.monotonic()
    yield
    record_stage(folder, name, time.monotonic() - started)


def record_stage(folder: Reconstruction, name: str, seconds: float) -> None:
    """Seconds of a stage, and this process's peak memory until its end; the latest run of a stage counts."""
    stages = {entry["name"]: entry for entry in recorded(folder).get("stages", [])}
    stages[name] = {"name": name, "seconds": round(seconds, 2), "peak_rss_mb": peak_mb()}
    record(folder, stages=list(stages.values()))
