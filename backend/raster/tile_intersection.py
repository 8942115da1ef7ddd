"""Extents of a splat's ellipse in rows of tiles, and the order of splats with equal depth, on the CPU."""

from __future__ import annotations

import math

import numpy as np

from .kernel import kernel
from .settings import ALPHA_MIN
from .splats import DEPTH, HALF_H, HALF_W, LOP, SLOPE, A, C, U, V

_LOG2_CUT = np.float32(math.log2(ALPHA_MIN))
_HALF = np.float32(0.5)
_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)


@kernel()
def _floor(x):
    """Return the floor of a float32 as an integer; on a GPU, math.floor would compute in float64."""
    whole = np.int64(x)
    return whole - 1 if np.float32(whole) > x else whole


@kernel()
def row_ends(splats, n, row, columns, height, tile_w, tile_h):
    """Return the first and last + 1 tile column that splat n's ellipse overlaps in tile row `row`.

    Tile sizes must be powers of 2.
    """
    per_tile_w = _ONE / np.float32(tile_w)
    v = splats[n, V]
    anchor = min(max(v, _ZERO), np.float32(height))
    slope = splats[n, SLOPE]
    u = splats[n, U] + slope * (v - anchor)
    half_w, half_h = splats[n, HALF_W], splats[n, HALF_H]
    box_first = max(_floor((u - half_w - _HALF) * per_tile_w), 0)
    box_last = min(_floor((u + half_w + _HALF) * per_tile_w) + 1, columns)
    if box_last - box_first < 2:
        return box_first, box_last
    top = max(np.float32(row * tile_h), v - half_h)
    bottom = min(np.float32((row + 1) * tile_h), v + half_h)
    # The rightmost point of the ellipse lies at y = v + peak, the leftmost at v - peak; elsewhere the span is narrower.
    reach = splats[n, LOP] - _LOG2_CUT
    peak = slope * reach / (splats[n, C] * half_w)
    y = min(max(v + peak, top), bottom)
    half = math.sqrt(max(reach - splats[n, C] * (y - v) * (y - v), _ZERO) / splats[n, A])
    right = splats[n, U] + slope * (y - anchor) + half
    y = min(max(v - peak, top), bottom)
    half = math.sqrt(max(reach - splats[n, C] * (y - v) * (y - v), _ZERO) / splats[n, A])
    left = splats[n, U] + slope * (y - anchor) - half
    first = max(_floor((left - _HALF) * per_tile_w), box_first)
    last = min(_floor((right + _HALF) * per_tile_w) + 1, box_last)
    return first, last


@kernel()
def tile_rows(splats, n, lines, tile_h):
    """Return the first and last + 1 tile row that splat n's bounding box overlaps."""
    per_tile_h = _ONE / np.float32(tile_h)
    first = max(_floor((splats[n, V] - splats[n, HALF_H]) * per_tile_h), 0)
    last = min(_floor((splats[n, V] + splats[n, HALF_H]) * per_tile_h) + 1, lines)
    return first, last


@kernel()
def order_ties(splats, ids, order, first, last):
    """Sort order[first:last] by position, shape, opacity, color and ID; heap sort, as thousands of splats may tie."""
    n = last - first
    for start in range(n // 2 - 1, -1, -1):
        _sift(splats, ids, order, first, start, n)
    for end in range(n - 1, 0, -1):
        order[first], order[first + end] = order[first + end], order[first]
        _sift(splats, ids, order, first, 0, end)


@kernel()
def _sift(splats, ids, order, first, root, end):
    while 2 * root + 1 < end:
        child = 2 * root + 1
        if child + 1 < end and _before(splats, ids, order[first + child], order[first + child + 1]):
            child += 1
        if not _before(splats, ids, order[first + root], order[first + child]):
            return
        order[first + root], order[first + child] = order[first + child], order[first + root]
        root = child


@kernel()
def _before(splats, ids, i, j):
    for column in range(DEPTH):
        if splats[i, column] != splats[j, column]:
            return splats[i, column] < splats[j, column]
    if ids[i] != ids[j]:
        return ids[i] < ids[j]
    return i < j
