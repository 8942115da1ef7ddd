"""Accumulation of the ranked object IDs of several images, pixel by pixel."""

from __future__ import annotations

from numba import prange

from .kernel import kernel


@kernel(parallel=True)
def add_ranked(total_ids, total_weights, ids, weights):
    """Add the ranked IDs of an image to running totals, which remain ranked.

    Totals are exact as long as no pixel receives more than n different IDs.

    Args:
        total_ids: (H, W, n) int32, initially -1; changed in place.
        total_weights: (H, W, n) float32, initially 0; changed in place.
        ids: (ranks, H, W) int32, sorted by descending weight in each pixel; -1 terminates a pixel's list.
        weights: (ranks, H, W) float32, the weight of each ID.
    """
    height, width, room = total_ids.shape
    for y in prange(height):
        for x in range(width):
            for rank in range(ids.shape[0]):
                owner = ids[rank, y, x]
                if owner < 0:
                    break
                at = 0
                while at < room - 1 and total_ids[y, x, at] != owner and total_ids[y, x, at] >= 0:
                    at += 1
                weight = weights[rank, y, x]
                if total_ids[y, x, at] == owner:
                    weight += total_weights[y, x, at]
                elif weight <= total_weights[y, x, at]:
                    continue
                while at > 0 and weight > total_weights[y, x, at - 1]:
                    total_ids[y, x, at] = total_ids[y, x, at - 1]
                    total_weights[y, x, at] = total_weights[y, x, at - 1]
                    at -= 1
                total_ids[y, x, at] = owner
                total_weights[y, x, at] = weight
