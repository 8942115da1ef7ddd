"""Tile intersections on the CPU: the splats of each tile, front to back.

The depths are radix sorted once; a counting sort by tile preserves this order. The result does not depend on the number
of threads. In each row of tiles, a splat is assigned only to the tiles between the exact left and right ends of its
ellipse.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from ..kernel import kernel
from ..splats import DEPTH, HALF_H
from ..tile_intersection import order_ties, row_ends, tile_rows

TILE_W = 64
TILE_H = 32

_CHUNK, _CHUNKS = 2048, 16
"""Smallest number of splats per chunk, and largest number of chunks, which are processed in parallel."""


@njit(inline="always", error_model="numpy")
def spread(index, columns, lines):
    """Return the index-th tile to process: rows of tiles in an interleaved order, each row from left to right.

    numba assigns each thread a run of consecutive indices. With interleaved rows, complex image regions are distributed
    over all threads, while neighboring tiles in a row still share cached splats.
    """
    step = int(lines * 0.6180339887) | 1
    while math.gcd(step, lines) > 1:
        step += 2
    return index // columns * step % lines * columns + index % columns


@kernel()
def depth_order(splats, ids):
    """Return the indices (int32) of the visible splats, nearest first; ties are broken by values and IDs."""
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
    # Depths are positive, so their bit patterns have the same order as the numbers.
    for shift in (0, 11, 22):
        starts = np.zeros(2049, np.int64)
        for i in range(count):
            starts[((keys[i] >> np.uint32(shift)) & np.uint32(2047)) + 1] += 1
        for i in range(2048):
            starts[i + 1] += starts[i]
        for i in range(count):
            digit = (keys[i] >> np.uint32(shift)) & np.uint32(2047)
            at = starts[digit]
            starts[digit] = at + 1
            other[at] = order[i]
            other_keys[at] = keys[i]
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
    """Find the intersections of tiles and splats.

    Returns isect_offsets (T + 1,): tile i blends the splats isect_ids[isect_offsets[i] : isect_offsets[i + 1]];
    isect_ids (M,) int32: splats of each tile, front to back; isect_rows (M,) int64: the gradient row of each
    intersection; row_offsets (N + 1,): splat n has the gradient rows row_offsets[n] to row_offsets[n + 1] - 1.
    """
    columns = (width + TILE_W - 1) // TILE_W
    lines = (height + TILE_H - 1) // TILE_H
    count = columns * lines
    # Chunks of the depth order are counted in parallel; then each one writes its own part of each tile's intersections.
    chunk = max(_CHUNK, (order.size + _CHUNKS - 1) // _CHUNKS)
    chunks = (order.size + chunk - 1) // chunk
    fills = np.zeros((chunks, count), np.int64)
    row_offsets = np.zeros(splats.shape[0] + 1, np.int64)
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
            row_offsets[s + 1] = met
    isect_offsets = np.empty(count + 1, np.int64)
    total = 0
    for tile in range(count):
        isect_offsets[tile] = total
        for k in range(chunks):
            here = fills[k, tile]
            fills[k, tile] = total
            total += here
    isect_offsets[count] = total
    for i in range(splats.shape[0]):
        row_offsets[i + 1] += row_offsets[i]
    isect_ids = np.empty(total, np.int32)
    isect_rows = np.empty(total, np.int64)
    for k in prange(chunks):
        for i in range(k * chunk, min(k * chunk + chunk, order.size)):
            s = order[i]
            top, bottom = tile_rows(splats, s, lines, TILE_H)
            row_id = row_offsets[s]
            for row in range(top, bottom):
                first, last = row_ends(splats, s, row, columns, height, TILE_W, TILE_H)
                for column in range(first, last):
                    at = fills[k, row * columns + column]
                    fills[k, row * columns + column] = at + 1
                    isect_ids[at] = s
                    isect_rows[at] = row_id
                    row_id += 1
    return isect_offsets, isect_ids, isect_rows, row_offsets
