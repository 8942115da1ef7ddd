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

import torch

from .kernels import TILE, raster_kernel

_SPARE, _DECAY = 1.125, 0.99
"""Ratio of the capacity to the largest number of intersections in the last images, and the factor by which a number
counts less for each image after it."""

_largest_totals: dict[torch.device, dict[int, float]] = {}
"""Device -> number of tiles of an image -> the largest number of intersections in the last images of that size."""
_MOST_SIZES = 256


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


def grid(width: int, height: int) -> tuple[int, int]:
    """Return the numbers of tile columns and tile rows."""
    return math.ceil(width / TILE), math.ceil(height / TILE)


def depth_order(splats: torch.Tensor, outlines: torch.Tensor, ids: torch.Tensor, width: int, height: int) -> Order:
    """Sort splats by depth and count their tiles; splats, outlines (N, 12) float32; ids (N,) int32."""
    count = splats.shape[0]
    columns, lines = grid(width, height)
    keys = torch.empty(count, dtype=torch.int64, device=splats.device)
    raster_kernel("write_keys").for_each(count, splats, count, keys)
    keys, order = torch.sort(keys)
    raster_kernel("order_equals").for_each(count, splats, ids, keys, count, order)
    counts = torch.empty_like(keys)
    raster_kernel("count_intersections").for_each(count, outlines, keys, order, count, columns, lines, height, counts)
    return Order(order, counts, torch.cumsum(counts, 0))


class IntersectionCount:
    """The number of intersections, copied to the host asynchronously."""

    def __init__(self, cumulative: torch.Tensor, tiles: int) -> None:
        """Begin to copy the last of the (N,) sums `cumulative`, for an image of this number of tiles."""
        self._device, self._tiles = cumulative.device, tiles
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
        """Return the capacity to use before the number is available.

        It does not follow from larger images, whose room for intersections may be what does not fit.
        """
        known = _largest_totals.get(self._device, {})
        total = known.get(self._tiles)
        if total is None:
            total = max((total for tiles, total in known.items() if tiles < self._tiles), default=0)
        return max(int(total * _SPARE), 1)

    def wait(self) -> int:
        """Wait for the number of intersections and return it."""
        if self._event is not None:
            self._event.synchronize()
        total = int(self._host.numpy()[0])
        known = _largest_totals.setdefault(self._device, {})
        if len(known) >= _MOST_SIZES and self._tiles not in known:
            known.clear()
        known[self._tiles] = max(total, _DECAY * known.get(self._tiles, 0))
        return total


def forget_capacity(device: torch.device) -> None:
    """Forget the numbers of intersections of images, after the memory of the device was not enough for one."""
    _largest_totals.pop(device, None)


def tile_intersections(order: Order, outlines: torch.Tensor, width: int, height: int, capacity: int) -> Intersections:
    """Return the first `capacity` intersections, in the order of splats from near to far, sorted by tile."""
    device = outlines.device
    columns, lines = grid(width, height)
    count = columns * lines
    # With fewer bits, the sort has fewer passes.
    kind = torch.int16 if count < 2**15 else torch.int32
    tile_ids = torch.full((capacity,), count, dtype=kind, device=device)
    splat_ids = torch.empty(capacity, dtype=torch.int32, device=device)
    first_rows, last_rows = torch.empty_like(order.order), torch.empty_like(order.order)
    splats = order.order.numel()
    name = "short" if kind is torch.int16 else "int"
    raster_kernel("write_intersections", TILE_ID=name).for_each(
        splats, outlines, order.order, order.counts, order.cumulative, splats, columns, lines, height, capacity,
        tile_ids, splat_ids, first_rows, last_rows,
    )  # fmt: skip
    tile_ids, isect_rows = torch.sort(tile_ids, stable=True)
    isect_offsets = torch.empty(count + 1, dtype=torch.int64, device=device)
    isect_ids = torch.empty_like(splat_ids)
    raster_kernel("find_tiles", TILE_ID=name).for_each(
        capacity, tile_ids, isect_rows, splat_ids, count, capacity, isect_offsets, isect_ids
    )
    return Intersections(isect_offsets, isect_ids, isect_rows, first_rows, last_rows, capacity)
