"""The exact most probable objects of each pixel on a GPU, at a cost independent of the number of objects.

P_i(x) is the sum of the blending weights of the splats with ID i. A tile has few distinct IDs: they are numbered within
the tile, and each pixel accumulates the sums of up to SLOTS of them in shared memory. For tiles with more IDs, the
splats are processed in several passes.
"""

from __future__ import annotations

import torch

from .binning import Intersections
from .kernels import THREADS, raster_kernel


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
    if not len(splats):
        return
    slots, names, bounds = _number(intersections, ids, isect_counts)
    ranks, height, width = best_id.shape
    raster_kernel("rank_ids", FLAT=tilts is not None)(
        isect_counts.numel(), THREADS, splats, tilts, slots, names, bounds, intersections.isect_offsets,
        intersections.isect_ids, isect_counts, columns, width, height, ranks, best_id, best_probability,
    )  # fmt: skip
