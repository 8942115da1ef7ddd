"""The most probable objects of every pixel on a GPU, exactly, at a cost that does not grow with the number of objects.

P_i(x) sums the blending weights of the splats with ID i. A tile meets few distinct IDs: they are numbered within the
tile, and every pixel adds up one number for each of up to SLOTS of them in shared memory; a tile that meets more goes
through its splats again.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import torch
from numba import cuda

from .cuda_bin import TILE, Lists
from .cuda_kernel import cuda_kernel, device_function, exp2, launch
from .cuda_tiles import (
    FIRST,
    NEXT,
    THREADS,
    disc_exponent,
    pixel_of,
    splat_exponent,
    stage_disc,
    stage_splat,
    staged_columns,
)
from .settings import ALPHA_MAX, ALPHA_MIN, STOP

SLOTS = 32
_STAGED = 64
_LOG2_CUT = np.float32(math.log2(ALPHA_MIN))
_ALPHA_MAX = np.float32(ALPHA_MAX)
_STOP = np.float32(STOP)
_HALF = np.float32(0.5)
_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)


@functools.cache
def _contest_kernel(flat: bool) -> Any:
    stride = staged_columns(flat)

    @device_function
    def weigh(stage, slots, count, x, y, lowest, sums, thread, t):
        """Add the weights in a pixel of staged splats to those of their slots; returns what light is left."""
        k = FIRST
        while k < count and t >= _STOP:
            if flat:
                exponent, _, _ = disc_exponent(stage, k, x, y)
            else:
                exponent = splat_exponent(stage, k, x, y)
            if exponent >= _LOG2_CUT:
                alpha = min(exp2(exponent), _ALPHA_MAX)
                slot = slots[k] - lowest
                if slot >= 0 and slot < SLOTS:
                    sums[slot, thread] += alpha * t
                t *= _ONE - alpha
            k += NEXT
        return t

    @device_function
    def rank(sums, names, lowest, count, thread, best_id, best_weight, px, py):
        """Let a pixel's sums take their places among its best so far; the first of equals stays before the others."""
        last = best_weight.shape[0] - 1
        least = best_weight[last, py, px]
        for slot in range(count):
            weight = sums[slot, thread]
            if weight > least:
                place = last
                while place > 0 and weight > best_weight[place - 1, py, px]:
                    best_weight[place, py, px] = best_weight[place - 1, py, px]
                    best_id[place, py, px] = best_id[place - 1, py, px]
                    place -= 1
                best_weight[place, py, px] = weight
                best_id[place, py, px] = names[lowest + slot]
                least = best_weight[last, py, px]

    @cuda_kernel(launch_bounds=THREADS)
    def contest(splats, tilts, slots, names, bounds, starts, members, ends, columns, best_id, best_weight):
        stage = cuda.shared.array((_STAGED, stride), np.float32, alignment=16)
        staged_slots = cuda.shared.array(_STAGED, np.int32)
        sums = cuda.shared.array((SLOTS, THREADS), np.float32)
        _, height, width = best_id.shape
        thread = cuda.threadIdx.x
        tile = cuda.blockIdx.x
        tile_x = np.int32(tile % columns * TILE)
        tile_y = np.int32(tile // columns * TILE)
        x, y = pixel_of(thread)
        px, py = np.int32(tile_x + x), np.int32(tile_y + y)
        inside = px < width and py < height
        first = starts[tile]
        last = first + ends[tile]
        for lowest in range(bounds[tile], bounds[tile + 1], SLOTS):
            count = min(SLOTS, bounds[tile + 1] - lowest)
            for slot in range(count):
                sums[slot, thread] = _ZERO
            t = _ZERO
            if inside:
                t = _ONE
            for base in range(first, last, _STAGED):
                cuda.syncthreads()
                here = min(_STAGED, last - base)
                if thread < here:
                    n = members[base + thread]
                    staged_slots[thread] = slots[base + thread]
                    if flat:
                        stage_disc(splats, tilts, n, tile_x, height, stage, thread)
                    else:
                        stage_splat(splats, n, tile_x, height, stage, thread)
                cuda.syncthreads()
                t = weigh(
                    stage, staged_slots, np.uint64(here), np.float32(x), np.float32(py) + _HALF, np.int32(lowest), sums,
                    np.uint64(thread), t,
                )  # fmt: skip
            if inside:
                rank(sums, names, lowest, count, np.uint64(thread), best_id, best_weight, px, py)

    return contest


def _number(lists: Lists, ids: torch.Tensor, ends: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Number the distinct (tile, ID) among the members that are drawn, tile by tile, IDs from small to large.

    slots (room,) int32: each member's number; names (room,) int32: the ID of each number; bounds (T + 1,) int32: tile
    i's numbers are bounds[i] to bounds[i + 1].
    """
    count = ends.numel()
    device = ids.device
    here = torch.arange(lists.room, device=device)
    tiles = torch.bucketize(here, lists.starts[1:], right=True)
    within = here - lists.starts[tiles]
    drawn = (tiles < count) & (within < ends[tiles.clamp(max=count - 1)])
    names = ids[lists.members.long()].long()
    keys = torch.where(drawn, (tiles << 32) + names + 2**31, 2**63 - 1)
    keys, order = torch.sort(keys)
    new = torch.ones_like(keys)
    new[1:] = keys[1:] != keys[:-1]
    numbers = torch.cumsum(new, 0) - 1
    slots = torch.empty(lists.room, dtype=torch.int32, device=device)
    slots[order] = numbers.int()
    of_number = torch.zeros_like(slots)
    of_number[numbers] = ((keys & (2**32 - 1)) - 2**31).int()
    edges = torch.arange(count + 1, device=device) << 32
    places = torch.searchsorted(keys, edges)
    bounds = torch.where(places < lists.room, numbers[places.clamp(max=lists.room - 1)], numbers[-1] + 1)
    return slots, of_number, bounds.int()


def most_probable(
    splats: torch.Tensor, tilts: torch.Tensor | None, ids: torch.Tensor, lists: Lists, ends: torch.Tensor,
    columns: int, best_id: torch.Tensor, best_weight: torch.Tensor,
) -> None:  # fmt: skip
    """Write into best_id (ranks, H, W) int32, full of -1, and best_weight (ranks, H, W) float32, full of 0, the objects
    of largest P_i, from the largest down.

    Of objects with equal weight the smallest ID comes first. ends (T,): how many members of each tile are drawn.
    """
    slots, names, bounds = _number(lists, ids, ends)
    launch(
        _contest_kernel(tilts is not None), ends.numel(), THREADS, splats, splats if tilts is None else tilts, slots,
        names, bounds, lists.starts, lists.members, ends, np.int32(columns), best_id, best_weight,
    )  # fmt: skip
