"""Regions of the screen that select splats: as a mask of pixels, so that a test of many splats is one lookup each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .picking import View

Path = Sequence[tuple[float, float]]
"""Positions in pixels from the upper left; the center of the first pixel is (0.5, 0.5)."""


def box_region(width: int, height: int, first: tuple[float, float], second: tuple[float, float]) -> NDArray[np.bool_]:
    """Return the pixels of an image whose centers are in the rectangle between two corners: (height, width) bool."""
    (left, right), (top, bottom) = sorted((first[0], second[0])), sorted((first[1], second[1]))
    across, down = np.arange(width) + 0.5, np.arange(height) + 0.5
    return ((down >= top) & (down <= bottom))[:, None] & ((across >= left) & (across <= right))


def brush_region(width: int, height: int, path: Path, radius: float) -> NDArray[np.bool_]:
    """Return the pixels of an image within a distance of a path: (height, width) bool.

    Args:
        width, height: size of the image in pixels.
        path: at least one position; they are connected by straight lines.
        radius: the distance in pixels.
    """
    region = np.zeros((height, width), bool)
    points = np.asarray(path, np.float64).reshape(-1, 2)
    for start, end in zip(points, points[1:] if len(points) > 1 else points):
        low = np.floor(np.minimum(start, end) - radius).astype(int).clip(0, (width, height))
        high = np.ceil(np.maximum(start, end) + radius).astype(int).clip(0, (width, height))
        across, down = np.arange(low[0], high[0]) + 0.5 - start[0], np.arange(low[1], high[1])[:, None] + 0.5 - start[1]
        along = end - start
        length2 = float(along @ along)
        at = np.clip((across * along[0] + down * along[1]) / length2, 0.0, 1.0) if length2 else 0.0
        near = (across - at * along[0]) ** 2 + (down - at * along[1]) ** 2 <= radius**2
        region[low[1] : high[1], low[0] : high[0]] |= near
    return region


def lasso_region(width: int, height: int, path: Path) -> NDArray[np.bool_]:
    """Return the pixels that a closed path surrounds an odd number of times: (height, width) bool."""
    points = np.asarray(path, np.float64).reshape(-1, 2)
    # Each edge toggles all pixels to its right in the rows that it crosses.
    toggles = np.zeros((height, width + 1), np.uint8)
    for (x0, y0), (x1, y1) in zip(points, np.roll(points, -1, axis=0)):
        if y0 == y1:
            continue
        first, last = sorted((y0, y1))
        rows = np.arange(*np.ceil(np.clip((first, last), 0.0, height) - 0.5).astype(int))
        crossing = x0 + (rows + 0.5 - y0) * ((x1 - x0) / (y1 - y0))
        toggles[rows, np.ceil(crossing - 0.5).clip(0, width).astype(int)] ^= 1
    return np.bitwise_xor.accumulate(toggles, axis=1)[:, :width].astype(bool)


def in_region(means: NDArray, matrix: NDArray, view: View, region: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find the splats whose centers are in front of a camera and in a region of its image.

    Args:
        means: (N, 3) centers of the splats.
        matrix: (4, 4) affine map from their coordinates to the world's.
        view: the camera or viewport.
        region: (height, width) bool, the pixels of the region.

    Returns:
        (N,) bool.
    """
    # In single precision and without temporary arrays of points, which take most of the time.
    rows = (np.asarray(view.viewmat, np.float64) @ matrix)[:3].astype(np.float32)
    x, y, depth = (np.asarray(means, np.float32) @ row[:3] for row in rows)
    depth += rows[2, 3]
    with np.errstate(all="ignore"):
        for values, shift, focal, middle in ((x, rows[0, 3], view.fx, view.cx), (y, rows[1, 3], view.fy, view.cy)):
            values += shift
            if not view.orthographic:
                values /= depth
            values *= np.float32(focal)
            values += np.float32(middle)
    found = (depth > view.near) & (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height)
    shown = np.flatnonzero(found)
    found[shown] = region[y[shown].astype(np.int64), x[shown].astype(np.int64)]
    return found


def in_sphere(means: NDArray, matrix: NDArray, center: NDArray, radius: float) -> NDArray[np.bool_]:
    """Find the splats whose centers are in a sphere of the world.

    Args:
        means: (N, 3) centers of the splats.
        matrix: (4, 4) affine map from their coordinates to the world's.
        center: (3,) center of the sphere.
        radius: its radius.

    Returns:
        (N,) bool.
    """
    away = np.asarray(means, np.float64) @ matrix[:3, :3].T + (matrix[:3, 3] - center)
    return np.einsum("ij,ij->i", away, away) <= radius**2


def to_camera(means: NDArray, matrix: NDArray, view: View) -> NDArray[np.float64]:
    """Return points (N, 3) in a view's camera space; `matrix` (4, 4) maps them to the world."""
    whole = np.asarray(view.viewmat, np.float64) @ matrix
    return np.asarray(means, np.float64) @ whole[:3, :3].T + whole[:3, 3]


def near_selected(points: NDArray, selected: NDArray[np.bool_], distance: float) -> NDArray[np.bool_]:
    """Find the points near selected ones, on a grid of cells that are half the distance wide.

    Args:
        points: (N, 3).
        selected: (N,) bool.
        distance: the largest distance between the cells of two near points, > 0.

    Returns:
        (N,) bool; true for the selected points, too.
    """
    return _near(_cell_numbers(points, distance), selected)


def away_from_others(points: NDArray, selected: NDArray[np.bool_], distance: float) -> NDArray[np.bool_]:
    """Find the selected points that are not near others, on the grid of `near_selected`; arguments as there."""
    numbers = _cell_numbers(points, distance)
    found = _near(numbers, selected)
    # In a large scene, most of the others are nowhere near the selected points.
    found[found] = ~_near(numbers[found], ~selected[found])
    return found


def _cell_numbers(points: NDArray, distance: float) -> NDArray[np.uint64]:
    """Return the number (N,) of the cell of each point."""
    if not len(points):
        return np.zeros(0, np.uint64)
    return _mixed(np.floor((points - points.min(0)) * (_CELLS / distance)).astype(np.int64))


def _near(numbers: NDArray[np.uint64], selected: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which of the numbers of cells (N,) are of cells near those of the selected points."""
    if not selected.any():
        return selected.copy()
    sides = np.arange(-_CELLS, _CELLS + 1)
    steps = np.stack(np.meshgrid(sides, sides, sides), -1).reshape(-1, 3)
    steps = steps[np.einsum("ij,ij->i", steps, steps) <= _CELLS**2]
    reached = np.unique(np.unique(numbers[selected]) + _mixed(steps)[:, None])
    place = np.minimum(np.searchsorted(reached, numbers), len(reached) - 1)
    return reached[place] == numbers


_CELLS = 2
_FACTORS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)


def _mixed(cells: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Return a number (n,) for each cell (n, 3); the number of a sum of cells is the sum of their numbers."""
    return (cells.astype(np.uint64) * _FACTORS).sum(1, dtype=np.uint64)
