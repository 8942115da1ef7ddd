"""Which tile meets which splat, front to back, on the CPU.

One radix sort of the depths, then a counting pass over the tiles keeps that order, so no key is sorted twice.
The lists do not depend on how many threads made them.
A tile row takes a splat only between the exact left and right ends of its ellipse inside that row.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from .cpu_project import DEPTH, HALF_H, HALF_W, LOP, SLOPE, A, C, U, V
from .kernel import kernel
from .settings import ALPHA_MIN

TILE_W = 64
TILE_H = 32

_LOG2_CUT = np.float32(math.log2(ALPHA_MIN))
_PER_TILE_W = np.float32(1.0 / TILE_W)
_PER_TILE_H = np.float32(1.0 / TILE_H)
_HALF = np.float32(0.5)
_ZERO = np.float32(0.0)
_CHUNK, _CHUNKS = 2048, 16
"""Splats that a thread takes at once: at least so many, in at most so many portions."""


@njit(inline="always", error_model="numpy")
def spread(index, columns, lines):
    """The index-th tile to work on: rows of tiles in an order that visits rows far apart, each from left to right.

    numba gives every thread one run of neighbouring indices; a busy part of the picture is shared this way, and
    neighbours in a row still find each other's splats in the cache.
    """
    step = int(lines * 0.6180339887) | 1
    while math.gcd(step, lines) > 1:
        step += 2
    return index // columns * step % lines * columns + index % columns


@kernel()
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


@kernel()
def _order_ties(splats, ids, order, first, last):
    """Sort order[first:last] by position, shape, opacity, colour and id; a heap sort, as thousands may tie."""
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


@kernel()
def _row_ends(splats, n, row, columns, height):
    """First and last + 1 tile column that splat n's ellipse reaches inside tile row `row`."""
    v = splats[n, V]
    anchor = min(max(v, _ZERO), np.float32(height))
    slope = splats[n, SLOPE]
    u = splats[n, U] + slope * (v - anchor)
    half_w, half_h = splats[n, HALF_W], splats[n, HALF_H]
    box_first = max(math.floor((u - half_w - _HALF) * _PER_TILE_W), 0)
    box_last = min(math.floor((u + half_w + _HALF) * _PER_TILE_W) + 1, columns)
    if box_last - box_first < 2:
        return int(box_first), int(box_last)
    top = max(np.float32(row * TILE_H), v - half_h)
    bottom = min(np.float32((row + 1) * TILE_H), v + half_h)
    # The rightmost point of the ellipse lies at y = v + peak, the leftmost at v - peak; off them the ends only shrink.
    reach = splats[n, LOP] - _LOG2_CUT
    peak = slope * reach / (splats[n, C] * half_w)
    y = min(max(v + peak, top), bottom)
    half = math.sqrt(max(reach - splats[n, C] * (y - v) * (y - v), _ZERO) / splats[n, A])
    right = splats[n, U] + slope * (y - anchor) + half
    y = min(max(v - peak, top), bottom)
    half = math.sqrt(max(reach - splats[n, C] * (y - v) * (y - v), _ZERO) / splats[n, A])
    left = splats[n, U] + slope * (y - anchor) - half
    first = max(math.floor((left - _HALF) * _PER_TILE_W), box_first)
    last = min(math.floor((right + _HALF) * _PER_TILE_W) + 1, box_last)
    return int(first), int(last)


@njit(inline="always", error_model="numpy")
def _tile_rows(splats, n, lines):
    """First and last + 1 tile row that splat n's box reaches."""
    first = max(math.floor((splats[n, V] - splats[n, HALF_H]) * _PER_TILE_H), 0)
    last = min(math.floor((splats[n, V] + splats[n, HALF_H]) * _PER_TILE_H) + 1, lines)
    return int(first), int(last)


@kernel(parallel=True)
def bin_splats(splats, order, width, height):
    """Fill the tiles' lists.

    Returns tiles (T + 1,) offsets into `members`; members (M,) int32 splats of each tile, front to back;
    places (M,) int64: the gradient row that belongs to each member; slots (N + 1,): the rows of each splat.
    """
    columns = (width + TILE_W - 1) // TILE_W
    lines = (height + TILE_H - 1) // TILE_H
    count = columns * lines
    # Chunks of the depth order are counted side by side, then each fills its own part of every tile's list.
    chunk = max(_CHUNK, (order.size + _CHUNKS - 1) // _CHUNKS)
    chunks = (order.size + chunk - 1) // chunk
    fills = np.zeros((chunks, count), np.int64)
    slots = np.zeros(splats.shape[0] + 1, np.int64)
    for k in prange(chunks):
        for i in range(k * chunk, min(k * chunk + chunk, order.size)):
            s = order[i]
            top, bottom = _tile_rows(splats, s, lines)
            met = 0
            for row in range(top, bottom):
                first, last = _row_ends(splats, s, row, columns, height)
                for column in range(first, last):
                    fills[k, row * columns + column] += 1
                met += max(last - first, 0)
            slots[s + 1] = met
    tiles = np.empty(count + 1, np.int64)
    total = 0
    for tile in range(count):
        tiles[tile] = total
        for k in range(chunks):
            here = fills[k, tile]
            fills[k, tile] = total
            total += here
    tiles[count] = total
    for i in range(splats.shape[0]):
        slots[i + 1] += slots[i]
    members = np.empty(total, np.int32)
    places = np.empty(total, np.int64)
    for k in prange(chunks):
        for i in range(k * chunk, min(k * chunk + chunk, order.size)):
            s = order[i]
            top, bottom = _tile_rows(splats, s, lines)
            slot = slots[s]
            for row in range(top, bottom):
                first, last = _row_ends(splats, s, row, columns, height)
                for column in range(first, last):
                    place = fills[k, row * columns + column]
                    fills[k, row * columns + column] = place + 1
                    members[place] = s
                    places[place] = slot
                    slot += 1
    return tiles, members, places, slots
