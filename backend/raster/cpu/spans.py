"""The pixel spans of splats in the rows of a tile, on the CPU."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from .. import simd
from ..discs import MIDDLE, Q0, QX, QY, SPOT, SPOT_U
from ..settings import ALPHA_MIN, TRANSMITTANCE_THRESHOLD
from ..splats import HALF_H, LOP, SLOPE, A, C, U, V
from .binning import TILE_H, TILE_W

STRIDE = TILE_W + simd.LANES
"""Length of a tile row in memory, since the last vector of a span may extend beyond the tile's right edge."""
ROW_SLOTS = TILE_H + simd.LANES
"""Length of the arrays written by `splat_rows`, which stores whole vectors from any row of the tile on."""
CHECK_EVERY = 32
"""Number of splats after which the rows of a tile are tested for remaining transmittance."""

_LOG2_CUT = np.float32(math.log2(ALPHA_MIN))
_TRANSMITTANCE_THRESHOLD = np.float32(TRANSMITTANCE_THRESHOLD)
_HALF = np.float32(0.5)
_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)
_ROUND_UP = np.float32(0.9999)
_MARGIN = np.float32(1e-3)
_FAR = np.float32(1e9)
_SPOT = np.float32(SPOT)


@njit(inline="always", error_model="numpy")
def splat_rows(splats, n, tile_x, tile_y, rows, height, starts, stops, tops, centers):
    """Compute the rows [y0, y1) of a tile that splat n covers, and the span in each row.

    For each row, the last four arguments receive the pixels [start, stop) where the splat may reach ALPHA_MIN, and the
    terms of log2 alpha = top - A (x - center)^2. The span may be one pixel too wide, but never too narrow.
    """
    v = splats[n, V]
    y0 = max(int(math.floor(v - splats[n, HALF_H])) - tile_y, 0)
    y1 = min(int(math.floor(v + splats[n, HALF_H])) + 1 - tile_y, rows)
    middle = simd.splat(v)
    anchor = simd.splat(min(max(v, _ZERO), np.float32(height)))
    u = simd.splat(splats[n, U] - np.float32(0.5) - np.float32(tile_x))
    slope = simd.splat(splats[n, SLOPE])
    lop = simd.splat(splats[n, LOP])
    c = simd.splat(splats[n, C])
    per_a = simd.splat(_ONE / splats[n, A])
    zero = simd.splat(_ZERO)
    for row in range(y0, y1, simd.LANES):
        y = simd.ramp(np.float32(tile_y + row) + np.float32(0.5))
        dy = y - middle
        top = lop - c * dy * dy
        center = u + slope * (y - anchor)
        half = simd.sqrt(simd.maximum((top - simd.splat(_LOG2_CUT)) * per_a, zero)) + simd.splat(_MARGIN)
        low = simd.minimum(simd.maximum(center - half, zero), simd.splat(np.float32(TILE_W)))
        high = simd.minimum(simd.maximum(center + half, simd.splat(-_ONE)), simd.splat(np.float32(TILE_W - 1)))
        simd.store(starts, row, simd.truncate(low + simd.splat(_ROUND_UP)))
        simd.store(stops, row, simd.truncate(high + simd.splat(_ONE)))
        simd.store(tops, row, top)
        simd.store(centers, row, center)
    return y0, y1


@njit(inline="always", error_model="numpy")
def disc_rows(splats, tilts, n, tile_x, tile_y, rows, height, starts, stops, tops, centers, tilted):
    """Compute the same as `splat_rows` for a disc; tops receives C dy^2, and tilted receives Q at the row's center."""
    middle, half_h = tilts[n, MIDDLE], splats[n, HALF_H]
    y0 = max(int(math.floor(middle - half_h)) - tile_y, 0)
    y1 = min(int(math.floor(middle + half_h)) + 1 - tile_y, rows)
    v = simd.splat(splats[n, V])
    anchor = simd.splat(min(max(splats[n, V], _ZERO), np.float32(height)))
    u = simd.splat(splats[n, U] - _HALF - np.float32(tile_x))
    slope = simd.splat(splats[n, SLOPE])
    reach = splats[n, LOP] - _LOG2_CUT
    a = splats[n, A]
    qx = tilts[n, QX]
    # In a row, the disc ends where A d^2 + C dy^2 = reach Q^2; it is unbounded if Q grows fast enough with d.
    square = a - reach * qx * qx
    bounded = square > np.float32(1e-4) * a
    per_square = simd.splat(_ONE / square)
    lean = simd.splat(reach * qx / square)
    spot_u = simd.splat(tilts[n, SPOT_U] - _HALF - np.float32(tile_x))
    spot2 = simd.splat(reach * _ONE / _SPOT)
    nowhere = simd.splat(-_FAR)
    zero = simd.splat(_ZERO)
    margin = simd.splat(_MARGIN)
    last = simd.splat(np.float32(TILE_W))
    for row in range(y0, y1, simd.LANES):
        y = simd.ramp(np.float32(tile_y + row) + _HALF)
        dy = y - v
        along = y - anchor
        top = simd.splat(splats[n, C]) * dy * dy
        center = u + slope * along
        q = simd.splat(tilts[n, Q0]) + simd.splat(tilts[n, QY]) * along
        root = simd.splat(a * reach) * q * q - simd.splat(square) * top
        half = simd.where(simd.at_least(root, zero), simd.sqrt(simd.maximum(root, zero)) * per_square, nowhere)
        high = lean * q + half
        low = lean * q - half
        if not bounded:
            high = simd.splat(_FAR)
            low = simd.splat(-_FAR)
        root = spot2 - dy * dy
        half = simd.where(simd.at_least(root, zero), simd.sqrt(simd.maximum(root, zero)), nowhere)
        low = simd.minimum(center + low, spot_u - half) - margin
        high = simd.maximum(center + high, spot_u + half) + margin
        low = simd.minimum(simd.maximum(low, zero), last)
        high = simd.minimum(simd.maximum(high, simd.splat(-_ONE)), last - simd.splat(_ONE))
        simd.store(starts, row, simd.truncate(low + simd.splat(_ROUND_UP)))
        simd.store(stops, row, simd.truncate(high + simd.splat(_ONE)))
        simd.store(tops, row, top)
        simd.store(centers, row, center)
        simd.store(tilted, row, q)
    return y0, y1


@njit(inline="always", error_model="numpy")
def live_rows(T, live):
    """Mark the rows of a tile with a pixel above the transmittance threshold; returns whether there is any."""
    stop = simd.splat(_TRANSMITTANCE_THRESHOLD)
    some = False
    for row in range(TILE_H):
        if live[row]:
            alive = False
            for x in range(0, TILE_W, simd.LANES):
                if simd.any_lane(simd.at_least(simd.load(T, row * STRIDE + x), stop)):
                    alive = True
                    break
            live[row] = alive
            some = some or alive
    return some
