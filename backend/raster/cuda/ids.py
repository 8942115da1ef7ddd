"""The exact most probable objects of each pixel on a GPU, at a cost independent of the number of objects.

P_i(x) is the sum of the blending weights of the splats with ID i. A tile has few distinct IDs: they are numbered within
the tile, and each pixel accumulates the sums of up to SLOTS of them in shared memory. For tiles with more IDs, the
splats are processed in several passes.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import torch
from numba import cuda

from ..settings import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_THRESHOLD
from .binning import TILE, Intersections
from .kernel import cuda_kernel, device_function, exp2, launch
from .staging import (
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

SLOTS = 32
_STAGED = 64
_LOG2_CUT = np.float32(math.log2(ALPHA_MIN))
_ALPHA_MAX = np.float32(ALPHA_MAX)
_TRANSMITTANCE_THRESHOLD = np.float32(TRANSMITTANCE_THRESHOLD)
_HALF = np.float32(0.5)
_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)


@functools.cache
def _contest_kernel(flat: bool) -> Any:
    stride = staged_columns(flat)

    @device_function
    def weigh(stage, slots, count, x, y, lowest, sums, thread, t):
        """Add the weights of staged splats in a pixel to the sums of their slots; returns the transmittance."""
        k = FIRST
        while k < count and t >= _TRANSMITTANCE_THRESHOLD:
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
    def rank(sums, names, lowest, count, thread, best_id, best_probability, px, py):
        """Insert a pixel's sums into its ranking; of equal sums, the first one is ranked first."""
        last = best_probability.shape[0] - 1
        least = best_probability[last, py, px]
        for slot in range(count):
            weight = sums[slot, thread]
            if weight > least:
                place = last
                while place > 0 and weight > best_probability[place - 1, py, px]:
                    best_probability[place, py, px] = best_probability[place - 1, py, px]
                    best_id[place, py, px] = best_id[place - 1, py, px]
                    place -= 1
                best_probability[place, py, px] = weight
                best_id[place, py, px] = names[lowest + slot]
                least = best_probability[last, py, px]

    @cuda_kernel(launch_bounds=THREADS)
    def contest(
        splats, tilts, slots, names, bounds, isect_offsets, isect_ids, isect_counts, columns, best_id, best_probability
    ):
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
        first = isect_offsets[tile]
        last = first + isect_counts[tile]
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
                    n = isect_ids[base + thread]
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
                rank(sums, names, lowest, count, np.uint64(thread), best_id, best_probability, px, py)

    return contest


def _number(
    intersections: Intersections, ids: torch.Tensor, isect_counts: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Number the distinct (tile, ID) pairs among the blended intersections, tile by tile, IDs in ascending order.

    Returns slots (capacity,) int32, the number of each intersection's pair; names (capacity,) int32, the ID of each
    number; bounds (T + 1,) int32: tile i has the numbers bounds[i] to bounds[i + 1] - 1.
    """
    count = isect_counts.numel()
    device = ids.device
    here = torch.arange(intersections.capacity, device=device)
    tiles = torch.bucketize(here, intersections.isect_offsets[1:], right=True)
    within = here - intersections.isect_offsets[tiles]
    drawn = (tiles < count) & (within < isect_counts[tiles.clamp(max=count - 1)])
    names = ids[intersections.isect_ids.long()].long()
    keys = torch.where(drawn, (tiles << 32) + names + 2**31, 2**63 - 1)
    keys, order = torch.sort(keys)
    new = torch.ones_like(keys)
    new[1:] = keys[1:] != keys[:-1]
    numbers = torch.cumsum(new, 0) - 1
    slots = torch.empty(intersections.capacity, dtype=torch.int32, device=device)
    slots[order] = numbers.int()
    of_number = torch.zeros_like(slots)
    of_number[numbers] = ((keys & (2**32 - 1)) - 2**31).int()
    edges = torch.arange(count + 1, device=device) << 32
    found = torch.searchsorted(keys, edges)
    bounds = torch.where(
        found < intersections.capacity, numbers[found.clamp(max=intersections.capacity - 1)], numbers[-1] + 1
    )
    return slots, of_number, bounds.int()


def most_probable(
    splats: torch.Tensor, tilts: torch.Tensor | None, ids: torch.Tensor, intersections: Intersections,
    isect_counts: torch.Tensor, columns: int, best_id: torch.Tensor, best_probability: torch.Tensor,
) -> None:  # fmt: skip
    """Write the objects with the largest P_i to best_id and best_probability, in descending order.

    best_id (ranks, H, W) int32 must be initialized with -1, and best_probability (ranks, H, W) float32 with 0. Of
    objects with equal probability, the smallest ID comes first. isect_counts (T,): number of blended intersections per
    tile.
    """
    slots, names, bounds = _number(intersections, ids, isect_counts)
    launch(
        _contest_kernel(tilts is not None), isect_counts.numel(), THREADS, splats, splats if tilts is None else tilts,
        slots, names, bounds, intersections.isect_offsets, intersections.isect_ids, isect_counts, np.int32(columns),
        best_id, best_probability,
    )  # fmt: skip
