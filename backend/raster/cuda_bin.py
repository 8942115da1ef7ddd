"""Which tile meets which splat, front to back, on a GPU.

The splats are sorted by depth once; each then writes the tiles it meets, one after the other in that order, and a
stable sort by tile (two passes, as tiles have few bits) keeps the order inside every tile. What the first sort leaves
equal is decided as on the CPU (tiles.py), so that pictures do not depend on the order of the input.

How many tiles are met altogether only the GPU knows. The lists get room for a little more than last time, and the
number is on its way to the host while the GPU goes on: the host looks at it after everything of the picture is under
way, and only if the room was too small the lists and the picture are made again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numba import cuda

from .cuda_kernel import cuda_kernel, device_function, launch_for_each
from .splats import DEPTH, HALF_H, U
from .tiles import order_ties, row_ends, tile_rows

TILE = 16

_UNSEEN = 2**63 - 1
_SIGN = 2**31
_SPARE = 1.125
"""Room for so many times the number of meetings in the last picture."""

_last_total: dict[torch.device, int] = {}


@dataclass
class Order:
    """The splats from near to far: order (N,) int64, the unseen last; counts (N,) int64 how many tiles each of these
    meets, and ends (N,) the sum up to and with it."""

    order: torch.Tensor
    counts: torch.Tensor
    ends: torch.Tensor


@dataclass
class Lists:
    """starts (T + 1,): tile i's splats are members[starts[i] : starts[i + 1]], front to back (int32), and places
    (int64) says which gradient row belongs to each; splat n owns the rows firsts[n] to lasts[n]. room: how many
    members the lists can hold."""

    starts: torch.Tensor
    members: torch.Tensor
    places: torch.Tensor
    firsts: torch.Tensor
    lasts: torch.Tensor
    room: int


@device_function
def _key(bits, splats, n):
    """Orders by depth, then by column; depths are positive, so their bit patterns sort like the numbers."""
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
    """The first of those with the same key puts all of them in order."""
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
def _tiles_met(outlines, n, columns, lines, height):
    """How many tiles splat n meets."""
    met = 0
    top, bottom = tile_rows(outlines, n, lines, TILE)
    for row in range(top, bottom):
        first, last = row_ends(outlines, n, row, columns, height, TILE, TILE)
        met += max(last - first, 0)
    return met


@device_function
def _write_tiles(outlines, n, columns, lines, height, slot, tiles, owners):
    """Write the tiles that splat n meets from `slot` on, as far as there is room."""
    top, bottom = tile_rows(outlines, n, lines, TILE)
    for row in range(top, bottom):
        first, last = row_ends(outlines, n, row, columns, height, TILE, TILE)
        for column in range(first, last):
            if slot < tiles.size:
                tiles[slot] = row * columns + column
                owners[slot] = n
            slot += 1


@cuda_kernel()
def _count(outlines, keys, order, columns, lines, height, counts):
    i = cuda.grid(1)
    if i < order.size:
        counts[i] = 0
        if keys[i] != _UNSEEN:
            counts[i] = _tiles_met(outlines, order[i], columns, lines, height)


@cuda_kernel()
def _write(outlines, order, counts, ends, columns, lines, height, tiles, owners, firsts, lasts):
    i = cuda.grid(1)
    if i < order.size:
        n = order[i]
        slot = ends[i] - counts[i]
        firsts[n] = min(slot, tiles.size)
        lasts[n] = min(ends[i], tiles.size)
        if counts[i] > 0:
            _write_tiles(outlines, n, columns, lines, height, slot, tiles, owners)


def grid(width: int, height: int) -> tuple[int, int]:
    """Columns and lines of tiles."""
    return math.ceil(width / TILE), math.ceil(height / TILE)


def depth_order(
    splats: torch.Tensor, outlines: torch.Tensor, ids: torch.Tensor, width: int, height: int
) -> Order:  # fmt: skip
    """splats and outlines (N, 12) float32 and ids (N,) int32 on the device."""
    count = splats.shape[0]
    columns, lines = grid(width, height)
    keys = torch.empty(count, dtype=torch.int64, device=splats.device)
    launch_for_each(_write_keys, count, splats.view(torch.int32), splats, keys)
    keys, order = torch.sort(keys)
    launch_for_each(_order_equals, count, splats, ids, keys, order)
    counts = torch.empty_like(keys)
    launch_for_each(_count, count, outlines, keys, order, np.int32(columns), np.int32(lines), np.int32(height), counts)
    return Order(order, counts, torch.cumsum(counts, 0))


class Total:
    """The number of meetings, on its way to the host."""

    def __init__(self, ends: torch.Tensor) -> None:
        self._device = ends.device
        self._event = None
        self._host = torch.zeros(1, dtype=torch.int64)
        if self._device.type == "cuda" and ends.numel():
            self._host = torch.empty(1, dtype=torch.int64, pin_memory=True)
            self._host.copy_(ends[-1:], non_blocking=True)
            self._event = torch.cuda.Event()
            self._event.record(torch.cuda.current_stream(self._device))
        elif ends.numel():
            self._host = ends[-1:]

    def room(self) -> int:
        """What to expect before it arrives."""
        return max(int(_last_total.get(self._device, 0) * _SPARE), 1)

    def wait(self) -> int:
        if self._event is not None:
            self._event.synchronize()
        total = int(self._host[0])
        _last_total[self._device] = total
        return total


def tile_lists(order: Order, outlines: torch.Tensor, width: int, height: int, room: int) -> Lists:
    """The first `room` meetings of tiles and splats, splat by splat from near to far, as the lists of the tiles."""
    device = outlines.device
    columns, lines = grid(width, height)
    count = columns * lines
    # The fewer bits, the fewer passes of the sort.
    kind = torch.int16 if count < 2**15 else torch.int32
    tiles = torch.full((room,), count, dtype=kind, device=device)
    owners = torch.zeros(room, dtype=torch.int32, device=device)
    firsts, lasts = torch.empty_like(order.order), torch.empty_like(order.order)
    launch_for_each(
        _write, order.order.numel(), outlines, order.order, order.counts, order.ends, np.int32(columns),
        np.int32(lines), np.int32(height), tiles, owners, firsts, lasts,
    )  # fmt: skip
    tiles, places = torch.sort(tiles, stable=True)
    starts = torch.searchsorted(tiles, torch.arange(count + 1, dtype=kind, device=device))
    return Lists(starts, owners[places], places, firsts, lasts, room)
