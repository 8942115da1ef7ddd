"""More points where features are few, and those of the capture that cannot be right.

COLMAP's points are corners of textures, so plain floors and walls have hardly any, and training has nothing to start
from there. A wrong point in front of a surface, on the other hand, begins as a large splat before the cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..capture import Capture
from .depth_maps import GRID, balance, find_depth_maps

MOST = 40_000
"""Largest number of points that are added; with more, they are farther apart."""

MOST_VIEWS = 400
"""Largest number of photos that are compared; of more, some at equal distances are."""


class DensePoints(NamedTuple):
    """Points of the surfaces that the photos of a capture agree on.

    Attributes:
        xyz: (n, 3) float64, at most one in each cube of the spacing, and none where the capture has one.
        rgb: (n, 3) uint8.
        in_front: (M,) bool, the points of the capture that are in front of the surfaces of more photos than agree.
    """

    xyz: np.ndarray
    rgb: np.ndarray
    in_front: np.ndarray


def find_dense_points(
    capture: Capture, views: Sequence[int], progress: Callable[[int, int], None] = lambda _done, _total: None
) -> DensePoints:
    """Find points on surfaces that photos show.

    Args:
        capture: the capture; must be prepared.
        views: indices of the views to use, in the order in which they were taken, if known.
        progress: called with the number of photos done, and of all.

    Raises:
        InputError: a photo cannot be read.
    """
    views = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, min(len(views), MOST_VIEWS)).astype(int))]
    maps = find_depth_maps(capture, views, progress)
    found, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    for index, each in maps.items():
        xyz, at = each.points(capture.views[index])
        found.append(xyz)
        colors.append(capture.image(index)[at[:, 1], at[:, 0]])
    xyz, rgb, known = np.concatenate(found), np.concatenate(colors), capture.points.xyz
    in_front = balance(capture, maps, known) < 0
    size = _spacing(capture, views)
    new = _thinned(xyz, known[~in_front], size)
    while len(new) > MOST:
        size *= max(np.sqrt(len(new) / MOST), 1.05)
        new = _thinned(xyz, known[~in_front], size)
    return DensePoints(xyz[new], rgb[new], in_front)


def _spacing(capture: Capture, views: Sequence[int]) -> float:
    """Return the typical distance between the points of neighboring pixels of the grid."""
    sizes: list[float] = []
    for view in (capture.views[index] for index in views):
        depths = capture.points.xyz @ view.viewmat[2, :3] + view.viewmat[2, 3]
        if (depths > 0).any():
            sizes.append(np.median(depths[depths > 0]) / view.K[0, 0] * np.sqrt(view.width * view.height / GRID))
    return float(np.median(sizes)) if sizes else 1.0


def _thinned(xyz: np.ndarray, known: np.ndarray, size: float) -> np.ndarray:
    """Return the indices of points (n, 3), at most one in each cube of a side, and none where a known one (m, 3) is."""
    cells = np.floor(np.concatenate([known, xyz]) / size).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return np.sort(first[first >= len(known)]) - len(known)
