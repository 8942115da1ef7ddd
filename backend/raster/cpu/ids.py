"""The exact most probable objects of each pixel, at a cost independent of the number of objects.

P_i(x) is the sum of the blending weights of the splats with ID i. The weights are computed once, in depth order, and
stored for the tile; a second pass sums them object by object, over the pixels that the object covers, and keeps the
requested number of largest sums.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from .. import simd
from ..discs import NEAREST, QX, SPOT, SPOT_U
from ..kernel import kernel
from ..settings import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_THRESHOLD
from ..splats import HALF_H, HALF_W, LOP, A, V
from .binning import TILE_H, TILE_W, spread
from .spans import CHECK_EVERY, ROW_SLOTS, STRIDE, disc_rows, live_rows, splat_rows

_LOG2_CUT = np.float32(math.log2(ALPHA_MIN))
_ALPHA_MAX = np.float32(ALPHA_MAX)
_TRANSMITTANCE_THRESHOLD = np.float32(TRANSMITTANCE_THRESHOLD)
_ONE = np.float32(1.0)
_HALF = np.float32(0.5)
_SPOT = np.float32(SPOT)


@njit(inline="always", error_model="numpy")
def _contest(winner_weight, winner, ranks, plane, at, weight, owner):
    """Insert `owner` into the ranking of the pixels from `at` on; lower entries move down."""
    moves = simd.above(weight, weight)
    for rank in range(ranks):
        place = rank * plane + at
        best, who = simd.load(winner_weight, place), simd.load_i(winner, place)
        moves = simd.either(moves, simd.above(weight, best))
        simd.store(winner_weight, place, simd.where(moves, weight, best))
        simd.store(winner, place, simd.where_i(moves, owner, who))
        weight, owner = simd.where(moves, best, weight), simd.where_i(moves, who, owner)


@kernel(parallel=True)
def most_probable(splats, tilts, ids, isect_offsets, isect_ids, best_id, best_probability):
    """Write the objects with the largest P_i to best_id (ranks, H, W) int32 and best_probability (ranks, H, W) float32.

    They are in descending order, with ID -1 and probability 0 where there are no more. Of objects with equal
    probability, the smallest ID comes first. tilts: None for 3D Gaussians.
    """
    columns = (best_id.shape[2] + TILE_W - 1) // TILE_W
    count = isect_offsets.size - 1
    for index in prange(count):
        _contest_tile(
            spread(np.int64(index), columns, count // columns), splats, tilts, ids, isect_offsets, isect_ids, best_id,
            best_probability,
        )  # fmt: skip


@kernel()
def _contest_tile(tile, splats, tilts, ids, isect_offsets, isect_ids, best_id, best_probability):
    ranks, height, width = best_id.shape
    columns = (width + TILE_W - 1) // TILE_W
    plane = TILE_H * STRIDE
    tile_x = (tile % columns) * TILE_W
    tile_y = (tile // columns) * TILE_H
    rows = min(TILE_H, height - tile_y)
    cols = min(TILE_W, width - tile_x)
    first = isect_offsets[tile]
    count = isect_offsets[tile + 1] - first
    T = np.zeros(plane, np.float32)
    current = np.zeros(plane, np.float32)
    winner_weight = np.zeros(ranks * plane, np.float32)
    winner = np.full(ranks * plane, -1, np.int32)
    live = np.zeros(TILE_H, np.bool_)
    starts = np.empty(ROW_SLOTS, np.int32)
    stops = np.empty(ROW_SLOTS, np.int32)
    tops = np.empty(ROW_SLOTS, np.float32)
    centers = np.empty(ROW_SLOTS, np.float32)
    tilted = np.empty(ROW_SLOTS, np.float32)
    for row in range(rows):
        live[row] = True
        for x in range(cols):
            T[row * STRIDE + x] = 1.0
    room = 0
    for k in range(count):
        n = isect_ids[first + k]
        across = min(int(2 * splats[n, HALF_W]) + 2, TILE_W) + simd.LANES
        down = min(int(2 * splats[n, HALF_H]) + 2, TILE_H)
        room += across * down
    kept = np.empty(room, np.float32)
    begin = np.empty(count + 1, np.int64)
    cut = simd.splat(_LOG2_CUT)
    stop_at = simd.splat(_TRANSMITTANCE_THRESHOLD)
    alpha_max = simd.splat(_ALPHA_MAX)
    one = simd.splat(_ONE)
    spot = simd.splat(_SPOT)
    used = 0
    for k in range(count):
        begin[k] = used
        if k % CHECK_EVERY == CHECK_EVERY - 1 and not live_rows(T, live):
            count = k
            break
        n = isect_ids[first + k]
        if tilts is None:
            y0, y1 = splat_rows(splats, n, tile_x, tile_y, rows, height, starts, stops, tops, centers)
            quad = simd.splat(-splats[n, A])
        else:
            y0, y1 = disc_rows(splats, tilts, n, tile_x, tile_y, rows, height, starts, stops, tops, centers, tilted)
            quad = simd.splat(splats[n, A])
            lop = simd.splat(splats[n, LOP])
            qx = simd.splat(tilts[n, QX])
            nearest = simd.splat(tilts[n, NEAREST])
            spot_u = tilts[n, SPOT_U] - _HALF - np.float32(tile_x)
        for row in range(y0, y1):
            row_top = simd.splat(tops[row])
            if tilts is not None:
                row_q = simd.splat(tilted[row])
                dy = np.float32(tile_y + row) + _HALF - splats[n, V]
                row_spot = simd.splat(_SPOT * dy * dy)
            for x in range(starts[row], stops[row], simd.LANES):
                at = row * STRIDE + x
                d = simd.ramp(np.float32(x) - centers[row])
                if tilts is None:
                    exponent = quad * d * d + row_top
                else:
                    per_q = one / (qx * d + row_q)
                    fall = (quad * d * d + row_top) * per_q * per_q
                    ds = simd.ramp(np.float32(x) - spot_u)
                    spot_fall = spot * ds * ds + row_spot
                    plane_drawn = simd.both(simd.at_least(per_q, nearest), simd.above(spot_fall, fall))
                    exponent = lop - simd.where(plane_drawn, fall, spot_fall)
                alpha = simd.minimum(simd.exp2(exponent), alpha_max)
                t = simd.load(T, at)
                alpha = simd.keep(simd.both(simd.at_least(exponent, cut), simd.at_least(t, stop_at)), alpha)
                simd.store(kept, used, alpha * t)
                simd.store(T, at, t * (one - alpha))
                used += simd.LANES
    owners = np.empty(count, np.int32)
    for k in range(count):
        owners[k] = ids[isect_ids[first + k]]
    grouped = np.argsort(owners, kind="mergesort")
    left = np.full(TILE_H, TILE_W, np.int32)
    right = np.zeros(TILE_H, np.int32)
    group = 0
    while group < count:
        owner = owners[grouped[group]]
        mine = simd.splat_i(owner)
        after = group + 1
        while after < count and owners[grouped[after]] == owner:
            after += 1
        alone = after - group == 1  # A single splat: no sum is necessary.
        low, high = TILE_H, 0
        for k in grouped[group:after]:
            n = isect_ids[first + k]
            if tilts is None:
                y0, y1 = splat_rows(splats, n, tile_x, tile_y, rows, height, starts, stops, tops, centers)
            else:
                y0, y1 = disc_rows(splats, tilts, n, tile_x, tile_y, rows, height, starts, stops, tops, centers, tilted)
            low = min(low, y0)
            high = max(high, y1)
            at_kept = begin[k]
            for row in range(y0, y1):
                start, stop = starts[row], stops[row]
                for x in range(start, stop, simd.LANES):
                    at = row * STRIDE + x
                    weight = simd.load(kept, at_kept)
                    if alone:
                        _contest(winner_weight, winner, ranks, plane, at, weight, mine)
                    else:
                        simd.store(current, at, simd.load(current, at) + weight)
                    at_kept += simd.LANES
                left[row] = min(left[row], start)
                right[row] = max(right[row], stop)
        group = after
        for row in range(low, high):
            if not alone:
                for x in range(left[row], right[row], simd.LANES):
                    at = row * STRIDE + x
                    _contest(winner_weight, winner, ranks, plane, at, simd.load(current, at), mine)
                    simd.store(current, at, simd.splat(np.float32(0.0)))
            left[row] = TILE_W
            right[row] = 0
    for rank in range(ranks):
        for row in range(rows):
            for x in range(cols):
                at = rank * plane + row * STRIDE + x
                best_id[rank, tile_y + row, tile_x + x] = winner[at]
                best_probability[rank, tile_y + row, tile_x + x] = winner_weight[at]
