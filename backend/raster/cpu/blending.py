"""Front-to-back blending of splats in tiles, on the CPU.

Each tile is processed by a single thread, so results do not depend on the number of threads. In each pixel row, a splat
is evaluated only in the exact span of its ellipse, sixteen pixels at a time (simd.py); the tile's planes stay in the
cache.

Per pixel, with splats sorted by depth: w_i = alpha_i T_i, T_{i+1} = T_i (1 - alpha_i), while
T_i >= TRANSMITTANCE_THRESHOLD.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

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
_ONE = np.float32(1.0)
_TINY = np.float32(1e-7)
_SPOT = np.float32(SPOT)


@njit(inline="always", error_model="numpy")
def _add(plane, at, value):
    simd.store(plane, at, simd.load(plane, at) + value)


@kernel(parallel=True)
def blend(
    splats, tilts, ids, labels, isect_offsets, isect_ids, want_labels, want_depth, want_median, want_surface,
    want_normals, want_moments, color, transmittance, label_probability, depth, median, surface, normals, moments,
    isect_counts,
):  # fmt: skip
    """Blend all tiles. All planes are float32; requested planes are written completely.

    Args:
        splats: (N, 12), projected splats.
        tilts: (N, 12) for discs, otherwise None.
        ids: (N,) int32.
        labels: (H, W) int32.
        isect_offsets, isect_ids: see `bin_splats`.
        want_labels, want_depth, want_median, want_surface, want_normals, want_moments: the requested planes.
        color: (3, H, W).
        transmittance: (H, W).
        label_probability: (H, W), the sum of w_i over the splats whose ID is the pixel's label.
        depth: (H, W), the sum of w_i z_i.
        median: (H, W), the z_i at which T falls below 1/2, 0 where it does not.
        surface: (H, W), the mean of the z_i, weighted by w_i, where T is at least 1/2 before them.
        normals: (3, H, W), the sum of w_i n_i; for discs only.
        moments: (2, H, W), the sums of w_i m_i and w_i m_i^2; for discs only. m_i is 1 / z_i minus that of the first
            splat in the pixel, to avoid cancellation where depths differ little.
        isect_counts: (T,), the number of blended intersections of each tile, for `blend_backward`.
    """
    columns = (transmittance.shape[1] + TILE_W - 1) // TILE_W
    count = isect_offsets.size - 1
    for index in prange(count):
        _blend_tile(
            spread(np.int64(index), columns, count // columns),
            splats, tilts, ids, labels, isect_offsets, isect_ids, want_labels, want_depth, want_median, want_surface,
            want_normals, want_moments, color, transmittance, label_probability, depth, median, surface, normals,
            moments, isect_counts,
        )  # fmt: skip


@kernel()
def _blend_tile(
    tile,
    splats, tilts, ids, labels, isect_offsets, isect_ids, want_labels, want_depth, want_median, want_surface,
    want_normals, want_moments, color, transmittance, label_probability, depth, median, surface, normals, moments,
    isect_counts,
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
    red = planes[plane : 2 * plane]
    green = planes[2 * plane : 3 * plane]
    blue = planes[3 * plane : 4 * plane]
    lab = planes[4 * plane : 5 * plane]
    dep = planes[5 * plane : 6 * plane]
    med = planes[6 * plane : 7 * plane]
    front = planes[7 * plane : 8 * plane]
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
        for x in range(cols):
            T[row * STRIDE + x] = 1.0
        if want_labels:
            for x in range(STRIDE):
                want[row * STRIDE + x] = labels[tile_y + row, tile_x + x] if x < cols else -1
    cut = simd.splat(_LOG2_CUT)
    stop_at = simd.splat(_TRANSMITTANCE_THRESHOLD)
    alpha_max = simd.splat(_ALPHA_MAX)
    one = simd.splat(_ONE)
    half = simd.splat(_HALF)
    tiny = simd.splat(_TINY)
    spot = simd.splat(_SPOT)
    first = isect_offsets[tile]
    last = isect_offsets[tile + 1]
    for isect in range(first, last):
        if (isect - first) % CHECK_EVERY == CHECK_EVERY - 1 and not live_rows(T, live):
            last = isect
            break
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
                d = simd.ramp(np.float32(x) - centers[row])
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
                if want_depth or want_median or want_surface:
                    here = z
                    if tilts is not None:
                        here = simd.where(plane_drawn, z * per_q, z)
                    if want_depth:
                        simd.store(dep, at, simd.load(dep, at) + w * here)
                    if want_median:
                        crosses = simd.both(simd.at_least(t, half), simd.above(half, after))
                        simd.store(med, at, simd.where(crosses, here, simd.load(med, at)))
                    if want_surface:
                        mean = simd.load(front, at)
                        share = simd.keep(simd.at_least(t, half), w / simd.maximum(one - after, tiny))
                        simd.store(front, at, mean + share * (here - mean))
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
    isect_counts[tile] = last - first
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
                label_probability[y, tile_x + x] = lab[row * STRIDE + x]
        if want_depth:
            for x in range(cols):
                depth[y, tile_x + x] = dep[row * STRIDE + x]
        if want_median:
            for x in range(cols):
                median[y, tile_x + x] = med[row * STRIDE + x]
        if want_surface:
            for x in range(cols):
                surface[y, tile_x + x] = front[row * STRIDE + x]
        if tilts is not None:
            if want_normals:
                for i in range(3):
                    for x in range(cols):
                        normals[i, y, tile_x + x] = extra[i * plane + row * STRIDE + x]
            if want_moments:
                for i in range(2):
                    for x in range(cols):
                        moments[i, y, tile_x + x] = extra[(3 + i) * plane + row * STRIDE + x]
