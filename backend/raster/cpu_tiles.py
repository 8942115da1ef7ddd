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
from .discs import MIDDLE, NEAREST, NORMAL_X, NORMAL_Y, NORMAL_Z, Q0, QX, QY, SPOT, SPOT_U
from .kernel import kernel
from .settings import ALPHA_MAX, ALPHA_MIN, STOP
from .splats import BLUE, DEPTH, GREEN, HALF_H, LOP, RED, SLOPE, A, C, U, V

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
_FAR = np.float32(1e9)
_SPOT = np.float32(SPOT)
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
def disc_rows(splats, tilts, n, tile_x, tile_y, rows, height, starts, stops, tops, centres, tilted):
    """As `splat_rows` for a disc: tops takes C dy^2 and `tilted` takes Q at the row's centre."""
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
    # In a row, the disc ends where A d^2 + C dy^2 = reach Q^2; without an end if Q grows as fast as d.
    square = a - reach * qx * qx
    ends = square > np.float32(1e-4) * a
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
        centre = u + slope * along
        q = simd.splat(tilts[n, Q0]) + simd.splat(tilts[n, QY]) * along
        root = simd.splat(a * reach) * q * q - simd.splat(square) * top
        half = simd.where(simd.at_least(root, zero), simd.sqrt(simd.maximum(root, zero)) * per_square, nowhere)
        high = lean * q + half
        low = lean * q - half
        if not ends:
            high = simd.splat(_FAR)
            low = simd.splat(-_FAR)
        root = spot2 - dy * dy
        half = simd.where(simd.at_least(root, zero), simd.sqrt(simd.maximum(root, zero)), nowhere)
        low = simd.minimum(centre + low, spot_u - half) - margin
        high = simd.maximum(centre + high, spot_u + half) + margin
        low = simd.minimum(simd.maximum(low, zero), last)
        high = simd.minimum(simd.maximum(high, simd.splat(-_ONE)), last - simd.splat(_ONE))
        simd.store(starts, row, simd.truncate(low + simd.splat(_ROUND_UP)))
        simd.store(stops, row, simd.truncate(high + simd.splat(_ONE)))
        simd.store(tops, row, top)
        simd.store(centres, row, centre)
        simd.store(tilted, row, q)
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


@njit(inline="always", error_model="numpy")
def _add(plane, at, value):
    simd.store(plane, at, simd.load(plane, at) + value)


@kernel(parallel=True)
def blend(
    splats, tilts, ids, labels, tiles, members, want_labels, want_depth, want_median, want_normals, want_moments,
    color, transmittance, weight, depth, median, normals, moments, ends,
):  # fmt: skip
    """Draw. labels (H, W) int32; color (3, H, W), transmittance, weight, depth and median (H, W): float32, all written.

    tilts: None, or those of discs. weight: the summed w_i of splats whose id equals the pixel's label. depth: the
    summed w_i z_i. median: the z_i with which T falls below 1/2, 0 where it never does. Of discs alone: normals
    (3, H, W), the summed w_i n_i, and moments (2, H, W), the summed w_i m_i and w_i m_i^2 of m = 1 / z less that of the
    first splat drawn, so that nothing cancels where depths differ little.
    ends (T,): how many members of each tile were needed, for `blend_backward`.
    """
    columns = (transmittance.shape[1] + TILE_W - 1) // TILE_W
    count = tiles.size - 1
    for index in prange(count):
        _blend_tile(
            spread(np.int64(index), columns, count // columns),
            splats, tilts, ids, labels, tiles, members, want_labels, want_depth, want_median, want_normals,
            want_moments, color, transmittance, weight, depth, median, normals, moments, ends,
        )  # fmt: skip


@kernel()
def _blend_tile(
    tile,
    splats, tilts, ids, labels, tiles, members, want_labels, want_depth, want_median, want_normals, want_moments,
    color, transmittance, weight, depth, median, normals, moments, ends,
):  # fmt: skip
    height, width = transmittance.shape
    columns = (width + TILE_W - 1) // TILE_W
    plane = TILE_H * STRIDE
    tile_x = (tile % columns) * TILE_W
    tile_y = (tile // columns) * TILE_H
    rows = min(TILE_H, height - tile_y)
    cols = min(TILE_W, width - tile_x)
    planes = np.zeros((7 if tilts is None else 13) * plane, np.float32)
    T = planes[:plane]
    red = planes[plane : 2 * plane]
    green = planes[2 * plane : 3 * plane]
    blue = planes[3 * plane : 4 * plane]
    lab = planes[4 * plane : 5 * plane]
    dep = planes[5 * plane : 6 * plane]
    med = planes[6 * plane : 7 * plane]
    extra = planes[7 * plane :]
    want = np.empty(plane, np.int32)
    live = np.zeros(TILE_H, np.bool_)
    starts = np.empty(ROW_SLOTS, np.int32)
    stops = np.empty(ROW_SLOTS, np.int32)
    tops = np.empty(ROW_SLOTS, np.float32)
    centres = np.empty(ROW_SLOTS, np.float32)
    tilted = np.empty(ROW_SLOTS, np.float32)
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
    spot = simd.splat(_SPOT)
    first = tiles[tile]
    last = tiles[tile + 1]
    for member in range(first, last):
        if (member - first) % _CHECK_EVERY == _CHECK_EVERY - 1 and not live_rows(T, live):
            last = member
            break
        n = members[member]
        if tilts is None:
            y0, y1 = splat_rows(splats, n, tile_x, tile_y, rows, height, starts, stops, tops, centres)
            quad = simd.splat(-splats[n, A])
        else:
            y0, y1 = disc_rows(splats, tilts, n, tile_x, tile_y, rows, height, starts, stops, tops, centres, tilted)
            quad = simd.splat(splats[n, A])
            lop = simd.splat(splats[n, LOP])
            qx = simd.splat(tilts[n, QX])
            nearest = simd.splat(tilts[n, NEAREST])
            spot_u = tilts[n, SPOT_U] - _HALF - np.float32(tile_x)
            per_z = simd.splat(_ONE / splats[n, DEPTH])
            normal_x = simd.splat(tilts[n, NORMAL_X])
            normal_y = simd.splat(tilts[n, NORMAL_Y])
            normal_z = simd.splat(tilts[n, NORMAL_Z])
        r = simd.splat(splats[n, RED])
        g = simd.splat(splats[n, GREEN])
        b = simd.splat(splats[n, BLUE])
        z = simd.splat(splats[n, DEPTH])
        mine = simd.splat_i(ids[n])
        for row in range(y0, y1):
            if not live[row]:
                continue
            row_top = simd.splat(tops[row])
            if tilts is not None:
                row_q = simd.splat(tilted[row])
                dy = np.float32(tile_y + row) + _HALF - splats[n, V]
                row_spot = simd.splat(_SPOT * dy * dy)
            for x in range(starts[row], stops[row], simd.LANES):
                at = row * STRIDE + x
                d = simd.ramp(np.float32(x) - centres[row])
                if tilts is None:
                    exponent = quad * d * d + row_top
                else:
                    q = qx * d + row_q
                    per_q = one / q
                    fall = (quad * d * d + row_top) * per_q * per_q
                    ds = simd.ramp(np.float32(x) - spot_u)
                    spot_fall = spot * ds * ds + row_spot
                    plane_drawn = simd.both(simd.at_least(per_q, nearest), simd.above(spot_fall, fall))
                    exponent = lop - simd.where(plane_drawn, fall, spot_fall)
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
                if want_depth or want_median:
                    here = z
                    if tilts is not None:
                        here = simd.where(plane_drawn, z * per_q, z)
                    if want_depth:
                        simd.store(dep, at, simd.load(dep, at) + w * here)
                    if want_median:
                        crosses = simd.both(simd.at_least(t, half), simd.above(half, after))
                        simd.store(med, at, simd.where(crosses, here, simd.load(med, at)))
                if tilts is not None:
                    if want_normals:
                        _add(extra, at, w * normal_x)
                        _add(extra, at + plane, w * normal_y)
                        _add(extra, at + 2 * plane, w * normal_z)
                    if want_moments:
                        inverse = per_z * simd.where(plane_drawn, q, one)
                        origin = simd.where(simd.at_least(t, one), inverse, simd.load(extra, at + 5 * plane))
                        simd.store(extra, at + 5 * plane, origin)
                        inverse = inverse - origin
                        _add(extra, at + 3 * plane, w * inverse)
                        _add(extra, at + 4 * plane, w * inverse * inverse)
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
        if tilts is not None:
            if want_normals:
                for i in range(3):
                    for x in range(cols):
                        normals[i, y, tile_x + x] = extra[i * plane + row * STRIDE + x]
            if want_moments:
                for i in range(2):
                    for x in range(cols):
                        moments[i, y, tile_x + x] = extra[(3 + i) * plane + row * STRIDE + x]


@kernel(parallel=True)
def blend_backward(
    splats, tilts, ids, labels, tiles, members, places, ends,
    want_labels, want_depth, want_normals, want_moments,
    color, transmittance, weight, depth, normals, moments,
    g_color, g_alpha, g_weight, g_depth, g_normals, g_moments, rows_out,
):  # fmt: skip
    """Gradient rows (M, GRADIENT_COLUMNS, or two times that with normals) of every (tile, splat) meeting.

    Front to back again: with dot_i = dL/dw_i, the light that is still to come is remaining = sum_{j>i} w_j dot_j,
    and dL/dalpha_i = T_i dot_i - remaining / (1 - alpha_i). g_alpha is the gradient of 1 - transmittance.
    """
    columns = (transmittance.shape[1] + TILE_W - 1) // TILE_W
    count = tiles.size - 1
    for index in prange(count):
        _blend_backward_tile(
            spread(np.int64(index), columns, count // columns),
            splats, tilts, ids, labels, tiles, members, places, ends, want_labels, want_depth, want_normals,
            want_moments, color, transmittance, weight, depth, normals, moments,
            g_color, g_alpha, g_weight, g_depth, g_normals, g_moments, rows_out,
        )  # fmt: skip


@kernel()
def _blend_backward_tile(
    tile,
    splats, tilts, ids, labels, tiles, members, places, ends, want_labels, want_depth, want_normals, want_moments,
    color, transmittance, weight, depth, normals, moments, g_color, g_alpha, g_weight, g_depth, g_normals,
    g_moments, rows_out,
):  # fmt: skip
    height, width = transmittance.shape
    columns = (width + TILE_W - 1) // TILE_W
    plane = TILE_H * STRIDE
    tile_x = (tile % columns) * TILE_W
    tile_y = (tile // columns) * TILE_H
    rows = min(TILE_H, height - tile_y)
    cols = min(TILE_W, width - tile_x)
    planes = np.zeros((8 if tilts is None else 14) * plane, np.float32)
    T = planes[:plane]
    remaining = planes[plane : 2 * plane]
    gr = planes[2 * plane : 3 * plane]
    gg = planes[3 * plane : 4 * plane]
    gb = planes[4 * plane : 5 * plane]
    ga = planes[5 * plane : 6 * plane]
    gl = planes[6 * plane : 7 * plane]
    gd = planes[7 * plane : 8 * plane]
    extra = planes[8 * plane :]
    want = np.empty(plane, np.int32)
    live = np.zeros(TILE_H, np.bool_)
    starts = np.empty(ROW_SLOTS, np.int32)
    stops = np.empty(ROW_SLOTS, np.int32)
    tops = np.empty(ROW_SLOTS, np.float32)
    centres = np.empty(ROW_SLOTS, np.float32)
    tilted = np.empty(ROW_SLOTS, np.float32)
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
            if tilts is not None:
                if want_normals:
                    for i in range(3):
                        extra[i * plane + at] = g_normals[i, y, px]
                        sum_ += normals[i, y, px] * g_normals[i, y, px]
                if want_moments:
                    for i in range(2):
                        extra[(3 + i) * plane + at] = g_moments[i, y, px]
                        sum_ += moments[i, y, px] * g_moments[i, y, px]
            remaining[at] = sum_
        if want_labels:
            for x in range(STRIDE):
                want[row * STRIDE + x] = labels[y, tile_x + x] if x < cols else -1
    cut = simd.splat(_LOG2_CUT)
    stop_at = simd.splat(_STOP)
    alpha_max = simd.splat(_ALPHA_MAX)
    one = simd.splat(_ONE)
    zero = simd.splat(_ZERO)
    spot = simd.splat(_SPOT)
    two_ln2 = simd.splat(_LN2 + _LN2)
    stride = rows_out.shape[1]
    first = tiles[tile]
    for member in range(first, tiles[tile + 1]):
        place = places[member]
        if member - first >= ends[tile]:
            for column in range(0, stride, simd.LANES):
                simd.store(rows_out, place * stride + column, zero)
            continue
        if (member - first) % _CHECK_EVERY == _CHECK_EVERY - 1:
            live_rows(T, live)
        n = members[member]
        if tilts is None:
            y0, y1 = splat_rows(splats, n, tile_x, tile_y, rows, height, starts, stops, tops, centres)
            quad = simd.splat(-splats[n, A])
        else:
            y0, y1 = disc_rows(splats, tilts, n, tile_x, tile_y, rows, height, starts, stops, tops, centres, tilted)
            quad = simd.splat(splats[n, A])
            lop = simd.splat(splats[n, LOP])
            qx = simd.splat(tilts[n, QX])
            nearest = simd.splat(tilts[n, NEAREST])
            spot_u = tilts[n, SPOT_U] - _HALF - np.float32(tile_x)
            per_z = simd.splat(_ONE / splats[n, DEPTH])
            normal_x = simd.splat(tilts[n, NORMAL_X])
            normal_y = simd.splat(tilts[n, NORMAL_Y])
            normal_z = simd.splat(tilts[n, NORMAL_Z])
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
        sum_nx = zero
        sum_ny = zero
        sum_nz = zero
        mq = zero
        mqx = zero
        mqy = zero
        msx = zero
        msy = zero
        for row in range(y0, y1):
            if not live[row]:
                continue
            row_top = simd.splat(tops[row])
            dy = np.float32(tile_y + row) + _HALF - splats[n, V]
            row_dy = simd.splat(dy)
            row0 = zero
            row1 = zero
            row_mq = zero
            row_ms = zero
            if tilts is not None:
                row_q = simd.splat(tilted[row])
                row_spot = simd.splat(_SPOT * dy * dy)
            for x in range(starts[row], stops[row], simd.LANES):
                at = row * STRIDE + x
                d = simd.ramp(np.float32(x) - centres[row])
                g_q = zero
                if tilts is None:
                    exponent = quad * d * d + row_top
                else:
                    q = qx * d + row_q
                    per_q = one / q
                    fall = (quad * d * d + row_top) * per_q * per_q
                    ds = simd.ramp(np.float32(x) - spot_u)
                    spot_fall = spot * ds * ds + row_spot
                    plane_drawn = simd.both(simd.at_least(per_q, nearest), simd.above(spot_fall, fall))
                    fall = simd.where(plane_drawn, fall, spot_fall)
                    exponent = lop - fall
                    per_q = simd.keep(plane_drawn, per_q)
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
                if tilts is None:
                    if want_depth:
                        wd = simd.load(gd, at)
                        dot = dot + wd * z
                        sum_z = sum_z + w * wd
                else:
                    if want_depth:
                        share = simd.where(plane_drawn, per_q, one)
                        wd = simd.load(gd, at)
                        dot = dot + wd * z * share
                        wd = w * wd * share
                        sum_z = sum_z + wd
                        g_q = g_q - wd * z * per_q
                    if want_moments:
                        inverse = per_z * simd.where(plane_drawn, q, one)
                        origin = simd.where(simd.at_least(t, one), inverse, simd.load(extra, at + 5 * plane))
                        simd.store(extra, at + 5 * plane, origin)
                        g1 = simd.load(extra, at + 3 * plane)
                        g2 = (inverse - origin) * simd.load(extra, at + 4 * plane)
                        dot = dot + (inverse - origin) * (g1 + g2)
                        g1 = w * per_z * (g1 + g2 + g2)
                        sum_z = sum_z - g1 * inverse
                        g_q = g_q + simd.keep(plane_drawn, g1)
                    if want_normals:
                        gx = simd.load(extra, at)
                        gy = simd.load(extra, at + plane)
                        gz = simd.load(extra, at + 2 * plane)
                        dot = dot + gx * normal_x + gy * normal_y + gz * normal_z
                        sum_nx = sum_nx + w * gx
                        sum_ny = sum_ny + w * gy
                        sum_nz = sum_nz + w * gz
                clear = one - alpha
                left = simd.load(remaining, at) - w * dot
                simd.store(remaining, at, left)
                simd.store(T, at, t * clear)
                sum_r = sum_r + w * wr
                sum_g = sum_g + w * wg
                sum_b = sum_b + w * wb
                # Where alpha was clamped or dropped it has no gradient; else alpha is the exponential's derivative.
                slope = simd.keep(simd.at_least(alpha_max, raw), alpha) * (t * dot - left / clear)
                if tilts is not None:
                    m0 = m0 + slope
                    in_spot = slope - simd.keep(plane_drawn, slope)
                    row_ms = row_ms + in_spot
                    msx = msx + in_spot * ds
                    slope = slope * per_q
                    g_q = g_q + two_ln2 * fall * slope
                    row_mq = row_mq + g_q
                    mqx = mqx + g_q * d
                    slope = slope * per_q
                row0 = row0 + slope
                slope = slope * d
                row1 = row1 + slope
                mxx = mxx + slope * d
            if tilts is None:
                m0 = m0 + row0
            else:
                mq = mq + row_mq
                mqy = mqy + row_mq * row_dy
                msy = msy + row_ms * row_dy
            row0 = row0 * row_dy
            my = my + row0
            myy = myy + row0 * row_dy
            mx = mx + row1
            mxy = mxy + row1 * row_dy
        ln2 = simd.splat(_LN2)
        moments_of = (m0 * ln2, my * ln2, myy * ln2, mx * ln2, mxy * ln2, mxx * ln2)
        sums = (*moments_of, sum_r, sum_g, sum_b, sum_z)
        if tilts is None:
            simd.store(rows_out, place * stride, simd.totals(sums))
        else:
            simd.store(rows_out, place * stride, simd.totals((*sums, mq, mqx, mqy, msx * ln2, msy * ln2, zero)))
            if want_normals:
                simd.store(rows_out, place * stride + simd.LANES, simd.totals((sum_nx, sum_ny, sum_nz)))
