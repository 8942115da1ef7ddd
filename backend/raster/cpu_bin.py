"""Which tile meets which splat, front to back, on the CPU.

One radix sort of the depths, then a counting pass over the tiles keeps that order, so no key is sorted twice.
The lists do not depend on how many threads made them.
A tile row takes a splat only between the exact left and right ends of its ellipse inside that row.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from .kernel import kernel
from .splats import DEPTH, HALF_H
from .tiles import order_ties, row_ends, tile_rows

TILE_W = 64
TILE_H = 32

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
            order_ties(splats, ids, order, first, last)
        first = last
    return order


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
            top, bottom = tile_rows(splats, s, lines, TILE_H)
            met = 0
            for row in range(top, bottom):
                first, last = row_ends(splats, s, row, columns, height, TILE_W, TILE_H)
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
            top, bottom = tile_rows(splats, s, lines, TILE_H)
            slot = slots[s]
            for row in range(top, bottom):
                first, last = row_ends(splats, s, row, columns, height, TILE_W, TILE_H)
                for column in range(first, last):
                    place = fills[k, row * columns + column]
                    fills[k, row * columns + column] = place + 1
                    members[place] = s
                    places[place] = slot
                    slot += 1
    return tiles, members, places, slots
