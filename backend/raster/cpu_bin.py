"""Which tile meets which splat, front to back, on the CPU.

One radix sort of the depths, then a counting pass over the tiles keeps that order, so no key is sorted twice.
A tile row takes a splat only between the exact left and right ends of its ellipse inside that row.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from .cpu_project import DEPTH, HALF_H, HALF_W, LOP, SLOPE, A, C, U, V
from .settings import ALPHA_MIN

TILE_W = 64
TILE_H = 32

_LOG2_CUT = math.log2(ALPHA_MIN)


@njit(cache=True, error_model="numpy")
def depth_order(splats, ids):
    """Indices (int32) of the visible splats, nearest first; equal depths go by look and id, not by index."""
    n = splats.shape[0]
    order = np.empty(n, np.int32)
    keys = np.empty(n, np.uint32)
    bits = splats.view(np.uint32)
    count = 0
    for i in range(n):
        if splats[i, HALF_H] > 0.0:
            order[count] = i
            keys[count] = bits[i, DEPTH]
            count += 1
    order = order[:count].copy()
    keys = keys[:count].copy()
    other = np.empty(count, np.int32)
    other_keys = np.empty(count, np.uint32)
    # Depths are positive, so their bit patterns sort like the numbers.
    for shift in (0, 11, 22):
        starts = np.zeros(2049, np.int64)
        for i in range(count):
            starts[((keys[i] >> np.uint32(shift)) & np.uint32(2047)) + 1] += 1
        for i in range(2048):
            starts[i + 1] += starts[i]
        for i in range(count):
            digit = (keys[i] >> np.uint32(shift)) & np.uint32(2047)
            place = starts[digit]
            starts[digit] = place + 1
            other[place] = order[i]
            other_keys[place] = keys[i]
        order, other = other, order
        keys, other_keys = other_keys, keys
    first = 0
    while first < count:
        last = first + 1
        while last < count and keys[last] == keys[first]:
            last += 1
        if last - first > 1:
            _order_ties(splats, ids, order, first, last)
        first = last
    return order


@njit(cache=True, error_model="numpy")
def _order_ties(splats, ids, order, first, last):
    """Sort order[first:last] by position, shape, opacity, colour and id; a heap sort, as thousands may tie."""
    n = last - first
    for start in range(n // 2 - 1, -1, -1):
        _sift(splats, ids, order, first, start, n)
    for end in range(n - 1, 0, -1):
        order[first], order[first + end] = order[first + end], order[first]
        _sift(splats, ids, order, first, 0, end)


@njit(cache=True, error_model="numpy")
def _sift(splats, ids, order, first, root, end):
    while 2 * root + 1 < end:
        child = 2 * root + 1
        if child + 1 < end and _before(splats, ids, order[first + child], order[first + child + 1]):
            child += 1
        if not _before(splats, ids, order[first + root], order[first + child]):
            return
        order[first + root], order[first + child] = order[first + child], order[first + root]
        root = child


@njit(cache=True, error_model="numpy")
def _before(splats, ids, i, j):
    for column in range(DEPTH):
        if splats[i, column] != splats[j, column]:
            return splats[i, column] < splats[j, column]
    if ids[i] != ids[j]:
        return ids[i] < ids[j]
    return i < j


@njit(cache=True, error_model="numpy")
def _row_ends(splats, n, row, columns, height):
    """First and last + 1 tile column that splat n's ellipse reaches inside tile row `row`."""
    v = splats[n, V]
    u = splats[n, U] + splats[n, SLOPE] * (v - min(max(v, 0.0), height))
    half_w, half_h = splats[n, HALF_W], splats[n, HALF_H]
    top = max(row * TILE_H - v, -half_h)
    bottom = min((row + 1) * TILE_H - v, half_h)
    # The rightmost point of the ellipse lies at dy = peak, the leftmost at -peak; off them the ends only shrink.
    reach = splats[n, LOP] - _LOG2_CUT
    peak = splats[n, SLOPE] * reach / (splats[n, C] * half_w)
    dy = min(max(peak, top), bottom)
    right = u + splats[n, SLOPE] * dy + math.sqrt(max(reach - splats[n, C] * dy * dy, 0.0) / splats[n, A])
    dy = min(max(-peak, top), bottom)
    left = u + splats[n, SLOPE] * dy - math.sqrt(max(reach - splats[n, C] * dy * dy, 0.0) / splats[n, A])
    first = max(math.floor((left - 0.5) / TILE_W), 0)
    last = min(math.floor((right + 0.5) / TILE_W) + 1, columns)
    return first, last


@njit(cache=True, error_model="numpy")
def bin_splats(splats, order, width, height):
    """Fill the tiles' lists.

    Returns tiles (T + 1,) offsets into `members`; members (M,) int32 splats of each tile, front to back;
    places (M,) int64: the gradient row that belongs to each member; slots (N + 1,): the rows of each splat.
    """
    columns = (width + TILE_W - 1) // TILE_W
    lines = (height + TILE_H - 1) // TILE_H
    n = splats.shape[0]
    tiles = np.zeros(columns * lines + 1, np.int64)
    slots = np.zeros(n + 1, np.int64)
    for i in range(order.size):
        s = order[i]
        top = max(int(math.floor((splats[s, V] - splats[s, HALF_H]) / TILE_H)), 0)
        bottom = min(int(math.floor((splats[s, V] + splats[s, HALF_H]) / TILE_H)) + 1, lines)
        met = 0
        for row in range(top, bottom):
            first, last = _row_ends(splats, s, row, columns, height)
            for column in range(first, last):
                tiles[row * columns + column + 1] += 1
                met += 1
        slots[s + 1] = met
    for i in range(columns * lines):
        tiles[i + 1] += tiles[i]
    for i in range(n):
        slots[i + 1] += slots[i]
    members = np.empty(tiles[columns * lines], np.int32)
    places = np.empty(tiles[columns * lines], np.int64)
    fill = tiles[:-1].copy()
    for i in range(order.size):
        s = order[i]
        top = max(int(math.floor((splats[s, V] - splats[s, HALF_H]) / TILE_H)), 0)
        bottom = min(int(math.floor((splats[s, V] + splats[s, HALF_H]) / TILE_H)) + 1, lines)
        slot = slots[s]
        for row in range(top, bottom):
            first, last = _row_ends(splats, s, row, columns, height)
            for column in range(first, last):
                tile = row * columns + column
                members[fill[tile]] = s
                places[fill[tile]] = slot
                fill[tile] += 1
                slot += 1
    return tiles, members, places, slots
