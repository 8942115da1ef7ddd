"""Which views show which cell of a model."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch

from ...model.object_model import ObjectModel, anchors_in_view
from ...raster import Camera, devices, object_ranks, rasterize
from ..step import frustum
from .division import NO_CELL, Cell, Division

LEAST_SHARE = 0.1
"""Least fraction of a view's pixels that a cell fills in the views that it is trained on."""

FEWEST_VIEWS = 12
"""Number of views of a cell that are used even if it fills less of them, those that show most of it."""

_LONGEST = 160
"""Longer side in pixels of the images in which the fractions are measured."""

_RANKS = 8
"""Number of parts of the model that are distinguished in a pixel."""


def shares(
    model: ObjectModel, division: Division, cell_of: np.ndarray, cameras: Iterable[Camera]
) -> Iterator[np.ndarray]:
    """Measure how much of each view shows each cell, and the seams.

    Args:
        model: the model that is divided.
        division: its cells.
        cell_of: (N,) the cell of each anchor.
        cameras: the views in scene units.

    Yields:
        (C + 1,) fractions of the view's pixels, 0 .. 1: of each cell, and of the anchors on seams.
    """
    count = len(division.cells)
    seam = division.on_seams(devices.host(model.anchors.positions)) & (cell_of != NO_CELL)
    # The renderer's object IDs tell parts apart: a cell's anchors, on seams or not, and those of no cell.
    parts = np.where(cell_of == NO_CELL, 2 * count, 2 * cell_of + seam).astype(np.int32)
    marked = replace(model, anchors=replace(model.anchors, ids=torch.from_numpy(parts).to(model.device)))
    for camera in cameras:
        small = camera.reduced(max(max(camera.width, camera.height) // _LONGEST, 1))
        splats = marked.generate(anchors_in_view(marked.anchors, *frustum(small)), small.center)
        with torch.no_grad():
            drawn = rasterize(*splats[:6], small, primitive=model.primitive)
        shown = np.zeros(2 * count + 1)
        for found, weight in zip(*(devices.host(plane) for plane in object_ranks(drawn, _RANKS)), strict=True):
            shown += np.bincount(found[found >= 0], weight[found >= 0], minlength=len(shown))
        shown /= small.width * small.height
        yield np.append(shown[:-1].reshape(count, 2).sum(1), shown[1:-1:2].sum())


def with_views(division: Division, names: list[str], found: np.ndarray) -> Division:
    """Return a division with the views of its cells and seams.

    Args:
        division: the cells.
        names: names of the V training views.
        found: (V, C + 1), of each view, from `shares`.
    """

    def chosen(of_part: np.ndarray) -> tuple[str, ...]:
        least = min(LEAST_SHARE, float(np.sort(of_part)[::-1][:FEWEST_VIEWS][-1]))
        return tuple(name for name, share in zip(names, of_part, strict=True) if share >= least and share > 0)

    cells = tuple(replace(cell, views=chosen(found[:, number])) for number, cell in enumerate(division.cells))
    return replace(division, cells=cells, seam_views=chosen(found[:, -1]))


def first_unseen(cells: Sequence[Cell]) -> int | None:
    """Return the number of the first cell that no view shows, or None."""
    return next((number for number, cell in enumerate(cells) if not cell.views), None)
