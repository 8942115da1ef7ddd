"""Blending splats front to back inside tiles, and its gradient, on the CPU.

Every tile is worked by one thread from start to end and every splat's gradient is summed in a fixed order, so
results do not depend on the number of threads. A splat touches, in each pixel row, only the exact span of its
ellipse, sixteen pixels at a time (see simd.py); the tile's planes stay in cache.

Per pixel, with splats sorted by depth: w_i = alpha_i T_i, T_{i+1} = T_i (1 - alpha_i), while T_i >= STOP.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from . import simd
from .cpu_bin import TILE_H, TILE_W, spread
from .cpu_project import BLUE, DEPTH, GRADIENT_COLUMNS, GREEN, HALF_H, LOP, RED, SLOPE, A, C, U, V
from .kernel import kernel
from .settings import ALPHA_MAX, ALPHA_MIN, STOP

STRIDE = TILE_W + simd.LANES
"""A tile row in memory: the last vector of a span may hang over the tile's right edge."""

_LOG2_CUT = np.float32(math.log2(ALPHA_MIN))
_ALPHA_MAX = np.float32(ALPHA_MAX)
_STOP = np.float32(STOP)
_HALF = np.float32(0.5)
_LN2 = np.float32(math.log(2.0))
_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)
_ROUND_UP = np.float32(0.9999)
_MARGIN = np.float32(1e-3)
ROW_SLOTS = TILE_H + simd.LANES
"""Length of the arrays that `splat_rows` fills: whole vectors from any row of the tile on."""

_CHECK_EVERY = 32


@njit(inline="always", error_model="numpy")
def splat_rows(splats, n, tile_x, tile_y, rows, height, starts, stops, tops, centres):
    """The rows [y0, y1) of a tile that splat n reaches, and for each of them, written to the last four arguments:

    its pixels [start, stop) where the splat may reach ALPHA_MIN, and the terms top and centre of
    log2 alpha = top - A (x - centre)^2. The span may be a pixel too wide, never too narrow.
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
        centre = u + slope * (y - anchor)
        half = simd.sqrt(simd.maximum((top - simd.splat(_LOG2_CUT)) * per_a, zero)) + simd.splat(_MARGIN)
        low = simd.minimum(simd.maximum(centre - half, zero), simd.splat(np.float32(TILE_W)))
        high = simd.minimum(simd.maximum(centre + half, simd.splat(-_ONE)), simd.splat(np.float32(TILE_W - 1)))
        simd.store(starts, row, simd.truncate(low + simd.splat(_ROUND_UP)))
        simd.store(stops, row, simd.truncate(high + simd.splat(_ONE)))
        simd.store(tops, row, top)
        simd.store(centres, row, centre)
    return y0, y1


@njit(inline="always", error_model="numpy")
def live_rows(T, live):
    """Mark the rows of a tile that still take light; returns whether any does."""
    stop = simd.splat(_STOP)
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


@kernel(parallel=True)
def blend(
    splats, ids, labels, tiles, members, want_labels, want_depth, want_median,
    color, transmittance, weight, depth, median, ends,
):  # fmt: skip
    """Draw. labels (H, W) int32; color (3, H, W), transmittance, weight, depth and median (H, W): float32, all written.

    weight: the summed w_i of splats whose id equals the pixel's label. depth: the summed w_i z_i. median: the z_i with
    which T falls below 1/2, 0 where it never does.
    ends (T,): how many members of each tile were needed, for `blend_backward`.
    """
    height, width = transmittance.shape
    columns = (width + TILE_W - 1) // TILE_W
    count = tiles.size - 1
    plane = TILE_H * STRIDE
    for index in prange(count):
        tile = spread(index, columns, count // columns)
        tile_x = (tile % columns) * TILE_W
        tile_y = (tile // columns) * TILE_H
        rows = min(TILE_H, height - tile_y)
        cols = min(TILE_W, width - tile_x)
        planes = np.zeros(7 * plane, np.float32)
        T = planes[:plane]
        red = planes[plane : 2 * plane]
        green = planes[2 * plane : 3 * plane]
        blue = planes[3 * plane : 4 * plane]
        lab = planes[4 * plane : 5 * plane]
        dep = planes[5 * plane : 6 * plane]
        med = planes[6 * plane :]
        want = np.empty(plane, np.int32)
        live = np.zeros(TILE_H, np.bool_)
        starts = np.empty(ROW_SLOTS, np.int32)
        stops = np.empty(ROW_SLOTS, np.int32)
        tops = np.empty(ROW_SLOTS, np.float32)
        centres = np.empty(ROW_SLOTS, np.float32)
        for row in range(rows):
            live[row] = True
            for x in range(cols):
                T[row * STRIDE + x] = 1.0
            if want_labels:
                for x in range(STRIDE):
                    want[row * STRIDE + x] = labels[tile_y + row, tile_x + x] if x < cols else -1
        cut = simd.splat(_LOG2_CUT)
        stop_at = simd.splat(_STOP)
        alpha_max = simd.splat(_ALPHA_MAX)
        one = simd.splat(_ONE)
        half = simd.splat(_HALF)
        first = tiles[tile]
        last = tiles[tile + 1]
        for member in range(first, last):
            if (member - first) % _CHECK_EVERY == _CHECK_EVERY - 1 and not live_rows(T, live):
                last = member
                break
            n = members[member]
            y0, y1 = splat_rows(splats, n, tile_x, tile_y, rows, height, starts, stops, tops, centres)
            quad = simd.splat(-splats[n, A])
            r = simd.splat(splats[n, RED])
            g = simd.splat(splats[n, GREEN])
            b = simd.splat(splats[n, BLUE])
            z = simd.splat(splats[n, DEPTH])
            mine = simd.splat_i(ids[n])
            for row in range(y0, y1):
                if not live[row]:
                    continue
                row_top = simd.splat(tops[row])
                for x in range(starts[row], stops[row], simd.LANES):
                    at = row * STRIDE + x
                    d = simd.ramp(np.float32(x) - centres[row])
                    exponent = quad * d * d + row_top
                    alpha = simd.minimum(simd.exp2(exponent), alpha_max)
                    t = simd.load(T, at)
                    alpha = simd.keep(simd.both(simd.at_least(exponent, cut), simd.at_least(t, stop_at)), alpha)
                    w = alpha * t
                    after = t * (one - alpha)
                    simd.store(T, at, after)
                    simd.store(red, at, simd.load(red, at) + w * r)
                    simd.store(green, at, simd.load(green, at) + w * g)
                    simd.store(blue, at, simd.load(blue, at) + w * b)
                    if want_labels:
                        match = simd.equal_i(simd.load_i(want, at), mine)
                        simd.store(lab, at, simd.load(lab, at) + simd.keep(match, w))
                    if want_depth:
                        simd.store(dep, at, simd.load(dep, at) + w * z)
                    if want_median:
                        crosses = simd.both(simd.at_least(t, half), simd.above(half, after))
                        simd.store(med, at, simd.where(crosses, z, simd.load(med, at)))
        ends[tile] = last - first
        for row in range(rows):
            y = tile_y + row
            for x in range(cols):
                at = row * STRIDE + x
                transmittance[y, tile_x + x] = T[at]
                color[0, y, tile_x + x] = red[at]
                color[1, y, tile_x + x] = green[at]
                color[2, y, tile_x + x] = blue[at]
            if want_labels:
                for x in range(cols):
                    weight[y, tile_x + x] = lab[row * STRIDE + x]
            if want_depth:
                for x in range(cols):
                    depth[y, tile_x + x] = dep[row * STRIDE + x]
            if want_median:
                for x in range(cols):
                    median[y, tile_x + x] = med[row * STRIDE + x]


@kernel(parallel=True)
def blend_backward(
    splats, ids, labels, tiles, members, places, ends, want_labels, want_depth,
    color, transmittance, weight, depth, g_color, g_alpha, g_weight, g_depth, rows_out,
):  # fmt: skip
    """Gradient rows (M, GRADIENT_COLUMNS) of every (tile, splat) meeting.

    Front to back again: with dot_i = dL/dw_i, the light that is still to come is remaining = sum_{j>i} w_j dot_j,
    and dL/dalpha_i = T_i dot_i - remaining / (1 - alpha_i). g_alpha is the gradient of 1 - transmittance.
    """
    height, width = transmittance.shape
    columns = (width + TILE_W - 1) // TILE_W
    count = tiles.size - 1
    plane = TILE_H * STRIDE
    for index in prange(count):
        tile = spread(index, columns, count // columns)
        tile_x = (tile % columns) * TILE_W
        tile_y = (tile // columns) * TILE_H
        rows = min(TILE_H, height - tile_y)
        cols = min(TILE_W, width - tile_x)
        planes = np.zeros(8 * plane, np.float32)
        T = planes[:plane]
        remaining = planes[plane : 2 * plane]
        gr = planes[2 * plane : 3 * plane]
        gg = planes[3 * plane : 4 * plane]
        gb = planes[4 * plane : 5 * plane]
        ga = planes[5 * plane : 6 * plane]
        gl = planes[6 * plane : 7 * plane]
        gd = planes[7 * plane :]
        want = np.empty(plane, np.int32)
        live = np.zeros(TILE_H, np.bool_)
        starts = np.empty(ROW_SLOTS, np.int32)
        stops = np.empty(ROW_SLOTS, np.int32)
        tops = np.empty(ROW_SLOTS, np.float32)
        centres = np.empty(ROW_SLOTS, np.float32)
        for row in range(rows):
            live[row] = True
            y = tile_y + row
            for x in range(cols):
                at = row * STRIDE + x
                px = tile_x + x
                T[at] = 1.0
                gr[at] = g_color[0, y, px]
                gg[at] = g_color[1, y, px]
                gb[at] = g_color[2, y, px]
                ga[at] = g_alpha[y, px]
                sum_ = color[0, y, px] * gr[at] + color[1, y, px] * gg[at] + color[2, y, px] * gb[at]
                sum_ += (_ONE - transmittance[y, px]) * ga[at]
                if want_labels:
                    gl[at] = g_weight[y, px]
                    sum_ += weight[y, px] * gl[at]
                if want_depth:
                    gd[at] = g_depth[y, px]
                    sum_ += depth[y, px] * gd[at]
                remaining[at] = sum_
            if want_labels:
                for x in range(STRIDE):
                    want[row * STRIDE + x] = labels[y, tile_x + x] if x < cols else -1
        cut = simd.splat(_LOG2_CUT)
        stop_at = simd.splat(_STOP)
        alpha_max = simd.splat(_ALPHA_MAX)
        one = simd.splat(_ONE)
        zero = simd.splat(_ZERO)
        first = tiles[tile]
        for member in range(first, tiles[tile + 1]):
            place = places[member]
            if member - first >= ends[tile]:
                simd.store(rows_out, place * GRADIENT_COLUMNS, zero)
                continue
            if (member - first) % _CHECK_EVERY == _CHECK_EVERY - 1:
                live_rows(T, live)
            n = members[member]
            y0, y1 = splat_rows(splats, n, tile_x, tile_y, rows, height, starts, stops, tops, centres)
            quad = simd.splat(-splats[n, A])
            r = simd.splat(splats[n, RED])
            g = simd.splat(splats[n, GREEN])
            b = simd.splat(splats[n, BLUE])
            z = simd.splat(splats[n, DEPTH])
            mine = simd.splat_i(ids[n])
            sum_r = zero
            sum_g = zero
            sum_b = zero
            sum_z = zero
            m0 = zero
            my = zero
            myy = zero
            mx = zero
            mxy = zero
            mxx = zero
            for row in range(y0, y1):
                if not live[row]:
                    continue
                row_top = simd.splat(tops[row])
                row_dy = simd.splat(np.float32(tile_y + row) + np.float32(0.5) - splats[n, V])
                row0 = zero
                row1 = zero
                for x in range(starts[row], stops[row], simd.LANES):
                    at = row * STRIDE + x
                    d = simd.ramp(np.float32(x) - centres[row])
                    exponent = quad * d * d + row_top
                    raw = simd.exp2(exponent)
                    alpha = simd.minimum(raw, alpha_max)
                    t = simd.load(T, at)
                    alpha = simd.keep(simd.both(simd.at_least(exponent, cut), simd.at_least(t, stop_at)), alpha)
                    w = alpha * t
                    wr = simd.load(gr, at)
                    wg = simd.load(gg, at)
                    wb = simd.load(gb, at)
                    dot = wr * r + wg * g + wb * b + simd.load(ga, at)
                    if want_labels:
                        match = simd.equal_i(simd.load_i(want, at), mine)
                        dot = dot + simd.keep(match, simd.load(gl, at))
                    if want_depth:
                        wd = simd.load(gd, at)
                        dot = dot + wd * z
                        sum_z = sum_z + w * wd
                    clear = one - alpha
                    left = simd.load(remaining, at) - w * dot
                    simd.store(remaining, at, left)
                    simd.store(T, at, t * clear)
                    sum_r = sum_r + w * wr
                    sum_g = sum_g + w * wg
                    sum_b = sum_b + w * wb
                    # Where alpha was clamped or dropped it has no gradient; else alpha is the exponential's derivative.
                    slope = simd.keep(simd.at_least(alpha_max, raw), alpha) * (t * dot - left / clear)
                    row0 = row0 + slope
                    slope = slope * d
                    row1 = row1 + slope
                    mxx = mxx + slope * d
                m0 = m0 + row0
                row0 = row0 * row_dy
                my = my + row0
                myy = myy + row0 * row_dy
                mx = mx + row1
                mxy = mxy + row1 * row_dy
            ln2 = simd.splat(_LN2)
            moments = (m0 * ln2, my * ln2, myy * ln2, mx * ln2, mxy * ln2, mxx * ln2)
            simd.store(rows_out, place * GRADIENT_COLUMNS, simd.totals((*moments, sum_r, sum_g, sum_b, sum_z)))
