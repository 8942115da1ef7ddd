"""Adding up ranked lists of IDs and weights, pixel by pixel: what several pictures show most of."""

from __future__ import annotations

from numba import prange

from .kernel import kernel


@kernel(parallel=True)
def add_ranked(total_ids, total_weights, ids, weights):
    """Add a picture's lists to the totals, which stay ranked.

    total_ids (H, W, n) int32, at first -1, and total_weights (H, W, n) float32, at first 0; ids (ranks, H, W) int32,
    where -1 ends a pixel's list, and weights (ranks, H, W). Totals are exact while a pixel meets no more than n IDs.
    """
    height, width, room = total_ids.shape
    for y in prange(height):
        for x in range(width):
            for rank in range(ids.shape[0]):
                owner = ids[rank, y, x]
                if owner < 0:
                    break
                place = 0
                while place < room - 1 and total_ids[y, x, place] != owner and total_ids[y, x, place] >= 0:
                    place += 1
                weight = weights[rank, y, x]
                if total_ids[y, x, place] == owner:
                    weight += total_weights[y, x, place]
                elif weight <= total_weights[y, x, place]:
                    continue
                while place > 0 and weight > total_weights[y, x, place - 1]:
                    total_ids[y, x, place] = total_ids[y, x, place - 1]
                    total_weights[y, x, place] = total_weights[y, x, place - 1]
                    place -= 1
                total_ids[y, x, place] = owner
                total_weights[y, x, place] = weight
