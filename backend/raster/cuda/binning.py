"""Tile intersections on a GPU: the splats of each tile, front to back.

The splats are sorted by depth once. In this order, the tiles that each splat intersects are written, and a stable sort
by tile (two passes, as tiles have few bits) preserves the depth order in each tile. Ties of the first sort are broken
as on the CPU (tile_intersection.py), so that images do not depend on the order of the input.

The number of intersections is computed on the GPU. The arrays have capacity for slightly more than in the last images,
and the number is copied to the host asynchronously: the host reads it after the whole image is queued. The
intersections and the image are computed again only if the capacity was too small. Training takes views in random order,
so the largest of the last images counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numba import cuda

from ..splats import DEPTH, HALF_H, U
from ..tile_intersection import order_ties, row_ends, tile_rows
from .kernel import cuda_kernel, device_function, launch_for_each

TILE = 16

_UNSEEN = 2**63 - 1
_SIGN = 2**31
_SPARE, _DECAY = 1.125, 0.99
"""Ratio of the capacity to the largest number of intersections in the last images, and the factor by which a number
counts less for each image after it."""

_largest_total: dict[torch.device, float] = {}


@dataclass
class Order:
    """The splats sorted by depth.

    Attributes:
        order: (N,) int64, splats from near to far, those that are not visible last.
        counts: (N,) int64, number of tiles that each of these intersects.
        cumulative: (N,), inclusive cumulative sum of counts.
    """

    order: torch.Tensor
    counts: torch.Tensor
    cumulative: torch.Tensor


@dataclass
class Intersections:
    """Intersections of tiles and splats, sorted by tile and depth.

    Attributes:
        isect_offsets: (T + 1,); tile i has the splats isect_ids[isect_offsets[i] : isect_offsets[i + 1]].
        isect_ids: (capacity,) int32, splats of the tiles, front to back.
        isect_rows: (capacity,) int64, the gradient row of each intersection.
        first_rows, last_rows: (N,); splat n has the gradient rows first_rows[n] to last_rows[n] - 1.
        capacity: length of isect_ids and isect_rows.
    """

    isect_offsets: torch.Tensor
    isect_ids: torch.Tensor
    isect_rows: torch.Tensor
    first_rows: torch.Tensor
    last_rows: torch.Tensor
    capacity: int


@device_function
def _key(bits, splats, n):
    """Return the sort key of splat n: depth, then column.

    Depths are positive, so their bit patterns have the same order as the numbers.
    """
    if not splats[n, HALF_H] > 0.0:
        return np.int64(_UNSEEN)
    across = np.int64(0)
    if splats[n, U] != 0.0:
        across = np.int64(bits[n, U])
        if across < 0:
            across = -(across & np.int64(_SIGN - 1))
    return np.int64(bits[n, DEPTH]) * np.int64(2 * _SIGN) + across + np.int64(_SIGN)


@cuda_kernel()
def _write_keys(bits, splats, keys):
    n = cuda.grid(1)
    if n < keys.size:
        keys[n] = _key(bits, splats, n)


@cuda_kernel()
def _order_equals(splats, ids, keys, order):
    """Sort runs of equal keys; each run is sorted by the thread of its first element."""
    first = cuda.grid(1)
    if first + 1 >= keys.size:
        return
    key = keys[first]
    if key != keys[first + 1] or key == _UNSEEN or (first > 0 and keys[first - 1] == key):
        return
    last = first + 2
    while last < keys.size and keys[last] == key:
        last += 1
    order_ties(splats, ids, order, first, last)


@device_function
def _count_tiles(outlines, n, columns, lines, height):
    """Return the number of tiles that splat n intersects."""
    met = 0
    top, bottom = tile_rows(outlines, n, lines, TILE)
    for row in range(top, bottom):
        first, last = row_ends(outlines, n, row, columns, height, TILE, TILE)
        met += max(last - first, 0)
    return met


@device_function
def _write_tiles(outlines, n, columns, lines, height, row_id, tile_ids, splat_ids):
    """Write the tiles that splat n intersects from row `row_id` on, as far as the capacity allows."""
    top, bottom = tile_rows(outlines, n, lines, TILE)
    for row in range(top, bottom):
        first, last = row_ends(outlines, n, row, columns, height, TILE, TILE)
        for column in range(first, last):
            if row_id < tile_ids.size:
                tile_ids[row_id] = row * columns + column
                splat_ids[row_id] = n
            row_id += 1


@cuda_kernel()
def _count_intersections(outlines, keys, order, columns, lines, height, counts):
    i = cuda.grid(1)
    if i < order.size:
        counts[i] = 0
        if keys[i] != _UNSEEN:
            counts[i] = _count_tiles(outlines, order[i], columns, lines, height)


@cuda_kernel()
def _write_intersections(
    outlines, order, counts, cumulative, columns, lines, height, tile_ids, splat_ids, first_rows, last_rows
):
    i = cuda.grid(1)
    if i < order.size:
        n = order[i]
        row_id = cumulative[i] - counts[i]
        first_rows[n] = min(row_id, tile_ids.size)
        last_rows[n] = min(cumulative[i], tile_ids.size)
        if counts[i] > 0:
            _write_tiles(outlines, n, columns, lines, height, row_id, tile_ids, splat_ids)


def grid(width: int, height: int) -> tuple[int, int]:
    """Return the numbers of tile columns and tile rows."""
    return math.ceil(width / TILE), math.ceil(height / TILE)


def depth_order(splats: torch.Tensor, outlines: torch.Tensor, ids: torch.Tensor, width: int, height: int) -> Order:
    """Sort splats by depth and count their tiles; splats, outlines (N, 12) float32; ids (N,) int32."""
    count = splats.shape[0]
    columns, lines = grid(width, height)
    keys = torch.empty(count, dtype=torch.int64, device=splats.device)
    launch_for_each(_write_keys, count, splats.view(torch.int32), splats, keys)
    keys, order = torch.sort(keys)
    launch_for_each(_order_equals, count, splats, ids, keys, order)
    counts = torch.empty_like(keys)
    launch_for_each(
        _count_intersections, count, outlines, keys, order, np.int32(columns), np.int32(lines), np.int32(height), counts
    )
    return Order(order, counts, torch.cumsum(counts, 0))


class IntersectionCount:
    """The number of intersections, copied to the host asynchronously."""

    def __init__(self, cumulative: torch.Tensor) -> None:
        self._device = cumulative.device
        self._event = None
        self._host = torch.zeros(1, dtype=torch.int64)
        if self._device.type == "cuda" and cumulative.numel():
            self._host = torch.empty(1, dtype=torch.int64, pin_memory=True)
            self._host.copy_(cumulative[-1:], non_blocking=True)
            self._event = torch.cuda.Event()
            self._event.record(torch.cuda.current_stream(self._device))
        elif cumulative.numel():
            self._host = cumulative[-1:]

    def expected_capacity(self) -> int:
        """Return the capacity to use before the number is available."""
        return max(int(_largest_total.get(self._device, 0) * _SPARE), 1)

    def wait(self) -> int:
        """Wait for the number of intersections and return it."""
        if self._event is not None:
            self._event.synchronize()
        total = int(self._host[0])
        _largest_total[self._device] = max(total, _DECAY * _largest_total.get(self._device, 0))
        return total


def tile_intersections(order: Order, outlines: torch.Tensor, width: int, height: int, capacity: int) -> Intersections:
    """Return the first `capacity` intersections, in the order of splats from near to far, sorted by tile."""
    device = outlines.device
    columns, lines = grid(width, height)
    count = columns * lines
    # With fewer bits, the sort has fewer passes.
    kind = torch.int16 if count < 2**15 else torch.int32
    tile_ids = torch.full((capacity,), count, dtype=kind, device=device)
    splat_ids = torch.zeros(capacity, dtype=torch.int32, device=device)
    first_rows, last_rows = torch.empty_like(order.order), torch.empty_like(order.order)
    launch_for_each(
        _write_intersections, order.order.numel(), outlines, order.order, order.counts, order.cumulative,
        np.int32(columns), np.int32(lines), np.int32(height), tile_ids, splat_ids, first_rows, last_rows,
    )  # fmt: skip
    tile_ids, isect_rows = torch.sort(tile_ids, stable=True)
    isect_offsets = torch.searchsorted(tile_ids, torch.arange(count + 1, dtype=kind, device=device))
    return Intersections(isect_offsets, splat_ids[isect_rows], isect_rows, first_rows, last_rows, capacity)
