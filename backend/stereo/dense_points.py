"""More points where features are few, and those of the capture that cannot be right.

COLMAP's points are corners of textures, so plain floors and walls have hardly any, and training has nothing to start
from there. A wrong point in front of a surface, on the other hand, begins as a large splat before the cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..capture import Capture
from ..shared.stopping import Check, proceed
from .depth_maps import balance, find_depth_maps

MOST = 40_000
"""Largest number of points that are added; with more, they are farther apart."""

MOST_VIEWS = 400
"""Largest number of photos that are compared; of more, some at equal distances are."""

_FINER = 1.5
"""Factor between the sizes of the cubes in which points are counted."""


class DensePoints(NamedTuple):
    """Points of the surfaces that the photos of a capture agree on.

    Attributes:
        xyz: (n, 3) float64, about as far apart as the pixels that show them from nearest, and none where the capture
            has one.
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
        progress: called with the work done, and all of it, at least once for each photo that is read or matched.

    Raises:
        InputError: a photo cannot be read.
    """
    views = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, min(len(views), MOST_VIEWS)).astype(int))]
    maps = find_depth_maps(capture, views, progress)

    def check() -> None:
        progress(1, 1)

    found, colors, sizes = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)], [np.zeros(0)]
    for index, each in maps.items():
        check()
        xyz, at = each.points(capture.views[index])
        found.append(xyz)
        colors.append(capture.image(index)[at[:, 1], at[:, 0]])
        sizes.append(each.depths[each.depths > 0] * each.stride / each.K[0, 0])
    xyz, rgb, size, known = np.concatenate(found), np.concatenate(colors), np.concatenate(sizes), capture.points.xyz
    in_front = balance(capture, maps, known, check=check) < 0
    new = _thinned(xyz, size, known[~in_front], check)
    while len(new) > MOST:
        size *= max(np.sqrt(len(new) / MOST), 1.05)
        new = _thinned(xyz, size, known[~in_front], check)
    return DensePoints(xyz[new], rgb[new], in_front)


def _thinned(xyz: np.ndarray, size: np.ndarray, known: np.ndarray, check: Check = proceed) -> np.ndarray:
    """Return the indices of points that are about as far apart as their sizes, and none near a known one.

    Args:
        xyz: (n, 3) points.
        size: (n,) distance to keep from others; of points nearby, those with the smallest are returned.
        known: (m, 3) other points.
        check: called for each of the steps of size.
    """
    level = np.floor(np.log(np.maximum(size, np.finfo(float).tiny)) / np.log(_FINER)).astype(np.int64)
    kept = np.zeros(0, np.int64)
    for each in np.unique(level):
        check()
        here = np.flatnonzero(level == each)
        before = np.concatenate([known, xyz[kept]])
        cells = np.floor(np.concatenate([before, xyz[here]]) / _FINER ** float(each)).astype(np.int64)
        # As np.unique does, which takes three times as long for rows.
        order = np.lexsort(cells.T[::-1])
        ordered = cells[order]
        first = order[np.append(True, (ordered[1:] != ordered[:-1]).any(1))]
        kept = np.concatenate([kept, here[first[first >= len(before)] - len(before)]])
    return np.sort(kept)
