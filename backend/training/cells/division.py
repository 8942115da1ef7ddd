"""The division of a model into cells, as cells.json.

{"format": 1, "checkpoint": "5f...", "overlap": 0.2,
 "cells": [{"core": [[null, null, null], [0.4, null, null]], "bounds": [[null, null, null], [0.45, null, null]],
            "anchors": 8210, "views": ["0001.png", ...]}, ...],
 "seam_views": ["0007.png", ...]}

The cores fill space without overlapping, and a trained model keeps what lies in them. The bounds, in which a cell is
trained, are larger by the overlap, so that its neighbors agree where they meet. All boxes are in scene units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...shared.errors import InputError
from ...shared.formats.json_file import read_json, write_json
from .region import EVERYWHERE, Bounds, bounds_of, inside

FORMAT = 1

NO_CELL = -1
"""Number of the cell of anchors that belong to none: those of distant surroundings, which each view sees."""

_OUTLIERS = 1.0
"""Percentage of the anchors at each end that is ignored when extents are compared."""


@dataclass(frozen=True)
class Cell:
    """A part of a model.

    core: box whose anchors the merged model keeps. bounds: box that is trained. anchors: number of anchors of the
    coarse model in the core. views: names of the training views that show it.
    """

    core: Bounds
    bounds: Bounds
    anchors: int
    views: tuple[str, ...] = ()


@dataclass(frozen=True)
class Division:
    """All cells of a model.

    checkpoint: hash of the checkpoint that was divided. overlap: of the bounds, relative to the cores. seam_views:
    names of the training views that show where cells meet.
    """

    checkpoint: str
    overlap: float
    cells: tuple[Cell, ...]
    seam_views: tuple[str, ...] = ()

    def cells_of(self, positions: np.ndarray) -> np.ndarray:
        """Return the cell in whose core each of the positions (n, 3) lies: (n,) int64."""
        found = np.full(len(positions), NO_CELL)
        for number, cell in enumerate(self.cells):
            found[inside(positions, cell.core)] = number
        return found

    def on_seams(self, positions: np.ndarray) -> np.ndarray:
        """Return which of the positions (n, 3) lie in the bounds of several cells: (n,) bool."""
        return np.sum([inside(positions, cell.bounds) for cell in self.cells], axis=0) > 1


def divide(positions: np.ndarray, count: int, overlap: float) -> list[Cell]:
    """Divide space into boxes with about equally many anchors.

    The box is cut again and again across its longest side, so that flat scenes are cut vertically.

    Args:
        positions: (N, 3) float64, the anchors in scene units, without those of distant surroundings.
        count: number of cells.
        overlap: by which fraction of its edge a cell is trained beyond its core, half of it on either side.

    Raises:
        InputError: the anchors lie in too few places for that many cells.
    """
    low, high = np.percentile(positions, [_OUTLIERS, 100 - _OUTLIERS], axis=0)
    cells = []
    for core in _cut(positions, count, EVERYWHERE):
        first, last = (np.array(corner) for corner in core)
        margin = overlap / 2 * (np.minimum(last, high) - np.maximum(first, low)).clip(min=0)
        cells.append(Cell(core, _box(first - margin, last + margin), int(inside(positions, core).sum())))
    return cells


def _cut(positions: np.ndarray, count: int, box: Bounds) -> list[Bounds]:
    """Cut a box into `count` boxes, none of them empty; positions: the anchors in it."""
    if count == 1:
        return [box]
    extents = np.ptp(np.percentile(positions, [_OUTLIERS, 100 - _OUTLIERS], axis=0), axis=0)
    of_first = count // 2
    for axis in np.argsort(-extents, kind="stable").tolist():
        at = _place_of_cut(positions[:, axis], of_first, count)
        if at is not None:
            break
    else:
        raise InputError("The anchors lie in too few places for so many cells; use fewer --cells.")
    low, high = (np.array(corner) for corner in box)
    end, start = high.copy(), low.copy()
    end[axis] = start[axis] = at
    before = positions[:, axis] < at
    return [
        *_cut(positions[before], of_first, _box(low, end)),
        *_cut(positions[~before], count - of_first, _box(start, high)),
    ]


def _place_of_cut(coordinates: np.ndarray, of_first: int, count: int) -> float | None:
    """Return where anchors are cut so that each of `count` cells, `of_first` of them before it, can have some.

    Their shares are equal, or as nearly as anchors with the same coordinate allow; None if none of them can be cut.
    """
    at, total = float(np.quantile(coordinates, of_first / count)), len(coordinates)
    least, most = of_first, total - (count - of_first)
    if least <= (coordinates < at).sum() <= most:
        return at
    places, numbers = np.unique(coordinates, return_counts=True)
    before = np.cumsum(numbers) - numbers
    possible = np.flatnonzero((before >= least) & (before <= most))
    if not len(possible):
        return None
    return float(places[possible[np.argmin(np.abs(before[possible] - total * of_first / count))]])


def _box(low: np.ndarray, high: np.ndarray) -> Bounds:
    a, b = low.tolist(), high.tolist()
    return (a[0], a[1], a[2]), (b[0], b[1], b[2])


def write_division(path: Path, division: Division) -> None:
    """Write cells.json."""

    def corners(box: Bounds) -> list[list[float | None]]:
        return [[x if np.isfinite(x) else None for x in corner] for corner in box]

    write_json(
        path,
        {
            "format": FORMAT, "checkpoint": division.checkpoint, "overlap": division.overlap,
            "cells": [
                {
                    "core": corners(cell.core), "bounds": corners(cell.bounds), "anchors": cell.anchors,
                    "views": list(cell.views),
                }
                for cell in division.cells
            ],
            "seam_views": list(division.seam_views),
        },
    )  # fmt: skip


def read_division(path: Path) -> Division:
    """Read cells.json; raise InputError if it is missing or damaged."""
    if not path.exists():
        raise InputError(f"{path} does not exist; run `split` on the reconstruction first.")
    try:
        stored = read_json(path)
        if stored["format"] != FORMAT:
            raise ValueError("another format")
        cells = tuple(_cell(cell) for cell in stored["cells"])
        if not cells:
            raise ValueError("there are no cells")
        return Division(str(stored["checkpoint"]), float(stored["overlap"]), cells, _names(stored["seam_views"]))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is damaged ({error}); use `split --restart` to divide the model anew.") from error


def _cell(stored: Any) -> Cell:
    core, bounds = bounds_of(stored["core"]), bounds_of(stored["bounds"])
    (low, high), (first, last) = np.array(core), np.array(bounds)
    if not (low < high).all() or (first > low).any() or (last < high).any():
        raise ValueError("a cell is not valid")
    return Cell(core, bounds, int(stored["anchors"]), _names(stored["views"]))


def _names(stored: Any) -> tuple[str, ...]:
    if not isinstance(stored, Sequence) or not all(isinstance(name, str) for name in stored):
        raise ValueError("names of views are missing")
    return tuple(stored)
