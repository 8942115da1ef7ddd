"""Gradient of the blending of splats in tiles, on the CPU; see blending.py.

The gradient of each splat is summed in a fixed order, so it does not depend on the number of threads.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from .. import simd
from ..discs import NEAREST, NORMAL_X, NORMAL_Y, NORMAL_Z, QX, SPOT, SPOT_U
from ..kernel import kernel
from ..settings import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_THRESHOLD
from ..splats import BLUE, DEPTH, GREEN, LOP, RED, A, V
from .binning import TILE_H, TILE_W, spread
from .spans import CHECK_EVERY, ROW_SLOTS, STRIDE, disc_rows, live_rows, splat_rows

_LOG2_CUT = np.float32(math.log2(ALPHA_MIN))
_ALPHA_MAX = np.float32(ALPHA_MAX)
_TRANSMITTANCE_THRESHOLD = np.float32(TRANSMITTANCE_THRESHOLD)
_HALF = np.float32(0.5)
_LN2 = np.float32(math.log(2.0))
_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)
_SPOT = np.float32(SPOT)


@kernel(parallel=True)
def blend_backward(
    splats, tilts, ids, labels, isect_offsets, isect_ids, isect_rows, isect_counts, want_labels, want_depth,
    want_normals, want_moments, color, transmittance, label_probability, depth, normals, moments,
    g_color, g_alpha, g_label_probability, g_depth, g_normals, g_moments, rows_out,
):  # fmt: skip
    """Write the gradient row of each intersection to rows_out (M, GRADIENT_COLUMNS, or twice that with normals).

    Splats are processed front to back. With dot_i = dL/dw_i and the remaining sum remaining = sum_{j>i} w_j dot_j,
    dL/dalpha_i = T_i dot_i - remaining / (1 - alpha_i). g_alpha is the gradient with respect to 1 - transmittance;
    isect_rows (M,) is the row of each intersection. The other arguments are as in `blend`.
    """
    columns = (transmittance.shape[1] + TILE_W - 1) // TILE_W
    count = isect_offsets.size - 1
    for index in prange(count):
        _blend_backward_tile(
            spread(np.int64(index), columns, count // columns),
            splats, tilts, ids, labels, isect_offsets, isect_ids, isect_rows, isect_counts, want_labels, want_depth,
            want_normals, want_moments, color, transmittance, label_probability, depth, normals, moments,
            g_color, g_alpha, g_label_probability, g_depth, g_normals, g_moments, rows_out,
        )  # fmt: skip


@kernel()
def _blend_backward_tile(
    tile,
    splats, tilts, ids, labels, isect_offsets, isect_ids, isect_rows, isect_counts, want_labels, want_depth,
    want_normals, want_moments, color, transmittance, label_probability, depth, normals, moments,
    g_color, g_alpha, g_label_probability, g_depth, g_normals, g_moments, rows_out,
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
    centers = np.empty(ROW_SLOTS, np.float32)
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
                gl[at] = g_label_probability[y, px]
                sum_ += label_probability[y, px] * gl[at]
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
    stop_at = simd.splat(_TRANSMITTANCE_THRESHOLD)
    alpha_max = simd.splat(_ALPHA_MAX)
    one = simd.splat(_ONE)
    zero = simd.splat(_ZERO)
    spot = simd.splat(_SPOT)
    two_ln2 = simd.splat(_LN2 + _LN2)
    stride = rows_out.shape[1]
    first = isect_offsets[tile]
    for isect in range(first, isect_offsets[tile + 1]):
        row_id = isect_rows[isect]
        if isect - first >= isect_counts[tile]:
            for column in range(0, stride, simd.LANES):
                simd.store(rows_out, row_id * stride + column, zero)
            continue
        if (isect - first) % CHECK_EVERY == CHECK_EVERY - 1:
            live_rows(T, live)
        n = isect_ids[isect]
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
                d = simd.ramp(np.float32(x) - centers[row])
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
                        depth_factor = simd.where(plane_drawn, per_q, one)
                        wd = simd.load(gd, at)
                        dot = dot + wd * z * depth_factor
                        wd = w * wd * depth_factor
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
                # A clamped or dropped alpha has no gradient; otherwise alpha is the derivative of the exponential.
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
            simd.store(rows_out, row_id * stride, simd.totals(sums))
        else:
            simd.store(rows_out, row_id * stride, simd.totals((*sums, mq, mqx, mqy, msx * ln2, msy * ln2, zero)))
            if want_normals:
                simd.store(rows_out, row_id * stride + simd.LANES, simd.totals((sum_nx, sum_ny, sum_nz)))
