"""Which points of a view are hidden by splats in front of them, without an image and without a graphics card.

The view is divided into cells. Each splat dims the cells that its ellipse reaches, by its opacity averaged over the
cell, and a point is visible while what is in front of it lets enough light through.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .blending import ALPHA_MAX, ALPHA_MIN
from .picking import PickObject, Rectangle, View, _Footprints, _footprints

VISIBLE = 0.1
"""Smallest fraction of a point's light that reaches the viewer if it counts as visible."""

_SMALLEST_CELL = 2.0
_MOST_PAIRS = 3_000_000
"""Largest number of pairs of splats and cells; with more, cells become larger."""


class Occlusion:
    """The light that splats let through, for each cell of a view and each depth.

    Args:
        objects: the objects whose splats hide others; hidden ones are ignored.
        view: the camera or viewport.
        rectangle: left, top, right, bottom in pixels: the part of the view in which points are tested.
    """

    def __init__(self, objects: Sequence[PickObject], view: View, rectangle: Rectangle) -> None:
        left, top, right, bottom = rectangle
        self._view, self._corner = view, np.array([left, top])
        splats = _footprints(objects, view, rectangle)
        self._cell, first, last = _cells(splats, self._corner, np.array([right, bottom]))
        self._across, self._down = np.maximum(
            np.ceil((np.array([right, bottom]) - self._corner) / self._cell).astype(np.int64), 1
        )
        sides = last - first + 1
        counts = sides.prod(1)
        owner = np.repeat(np.arange(len(counts)), counts)
        # The place of each pair among those of its splat, as a column and a row of cells.
        place = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
        column = first[owner, 0] + place % sides[owner, 0]
        row = first[owner, 1] + place // sides[owner, 0]
        alpha = self._alphas(splats, owner, np.stack([column, row], 1))
        kept = alpha >= ALPHA_MIN
        owner, number, alpha = owner[kept], (row * self._across + column)[kept], alpha[kept]
        order = np.argsort(number, kind="stable")  # Splats are sorted by depth, which is kept in each cell.
        self._depths = splats.depth
        self._places = number[order] * (len(splats.depth) + 1) + owner[order]
        self._dark = np.concatenate([[0.0], np.cumsum(np.log1p(-np.minimum(alpha[order], ALPHA_MAX)))])
        self._starts = np.searchsorted(number[order], np.arange(self._across * self._down))

    def light(self, points: NDArray, thickness: NDArray | float = 0.0) -> NDArray[np.float64]:
        """Return the fraction of light that reaches the viewer from points.

        Args:
            points: (N, 3) in camera space.
            thickness: (N,) distances; splats that are less than this in front of a point do not hide it, since a
                surface consists of splats that overlap.

        Returns:
            (N,) in 0 .. 1; 0 for points outside of the rectangle.
        """
        light = np.zeros(len(points))
        with np.errstate(all="ignore"):
            cells = np.floor((self._view.pixels(points) - self._corner) / self._cell)
        inside = np.flatnonzero(
            (cells >= 0).all(1) & (cells < (self._across, self._down)).all(1) & (points[:, 2] > self._view.near)
        )
        column, row = cells[inside].astype(np.int64).T
        number = row * self._across + column
        nearest = points[:, 2] * (1.0 - _SAME_DEPTH) - thickness
        in_front = np.searchsorted(self._depths, nearest[inside])
        end = np.searchsorted(self._places, number * (len(self._depths) + 1) + in_front)
        light[inside] = np.exp(self._dark[end] - self._dark[self._starts[number]])
        return light

    def _alphas(self, splats: _Footprints, owner: NDArray, cells: NDArray) -> NDArray[np.float64]:
        """Return the opacity (n,) of splats averaged over cells (n, 2), by a blur of the cell's size."""
        blur = self._cell**2 / 12.0
        a = splats.across2 + splats.slope**2 * splats.down2
        b = splats.slope * splats.down2
        before = splats.across2 * splats.down2
        a, c = a + blur, splats.down2 + blur
        after = np.maximum(a * c - b * b, 1e-30)
        fainter = splats.opacity * np.sqrt(before / after)
        off = self._corner + (cells + 0.5) * self._cell - splats.center[owner]
        x, y = off.T
        power = 0.5 * (c[owner] * x * x - 2.0 * b[owner] * x * y + a[owner] * y * y) / after[owner]
        return fainter[owner] * np.exp(-power)


_SAME_DEPTH = 1e-6
"""Relative difference of depths within which splats do not hide each other."""


def _cells(splats: _Footprints, corner: NDArray, end: NDArray) -> tuple[float, NDArray[np.int64], NDArray[np.int64]]:
    """Return the size of cells, and the first and last cell (n, 2) in the rectangle that each splat reaches."""
    cell = _SMALLEST_CELL
    while True:
        most = np.maximum(np.ceil((end - corner) / cell), 1) - 1
        first, last = (
            np.floor((splats.center + sign * splats.half - corner) / cell).clip(0, most).astype(np.int64)
            for sign in (-1.0, 1.0)
        )
        if (last - first + 1).prod(1).sum() <= _MOST_PAIRS or (most == 0).all():
            return cell, first, last
        cell *= 1.5
