"""Gradient of the blending of splats in tiles, on a GPU; see blending.py.

The gradient of a splat is a sum over pixels. A reduction across a warp for each splat would dominate the run time, so
eight splats are processed together, one per warp. In the first phase, each thread corresponds to a pixel: it visits the
eight splats and writes their blending weights w and dL/d(log2 alpha) to shared memory. In the second phase, each warp
corresponds to a splat: its lanes visit the pixels with sums in registers, which leaves only 32 partial sums. No two
threads add to the same address, so the result is deterministic.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from numba import cuda

from ..settings import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_THRESHOLD
from ..splats import G_BLUE, G_DEPTH, G_GREEN, G_NORMAL, G_RED, M0, MQ, MQX, MQY, MSX, MSY, MX, MXX, MXY, MY, MYY
from .binning import TILE
from .kernel import WARP, any_in_warp, cuda_kernel, device_function, exp2, reciprocal, sync_warp
from .staging import (
    ACROSS,
    ANCHOR,
    DOWN,
    FIRST,
    NEXT,
    PER_DEPTH,
    S_BLUE,
    S_DEPTH,
    S_GREEN,
    S_NORMAL_X,
    S_NORMAL_Y,
    S_NORMAL_Z,
    S_Q0,
    S_QX,
    S_QY,
    S_RED,
    S_SPOT_U,
    THREADS,
    Wanted,
    disc_exponent,
    offsets,
    pixel_of,
    splat_exponent,
    stage_disc,
    stage_splat,
    staged_columns,
)

WARPS = THREADS // WARP
STAGED_BACKWARD = 64
"""Number of splats staged in shared memory at a time."""

_LOG2_CUT = np.float32(math.log2(ALPHA_MIN))
_ALPHA_MAX = np.float32(ALPHA_MAX)
_TRANSMITTANCE_THRESHOLD = np.float32(TRANSMITTANCE_THRESHOLD)
_LN2 = np.float32(math.log(2.0))
_TWO_LN2 = np.float32(2.0 * math.log(2.0))
_ZERO = np.float32(0.0)
_HALF = np.float32(0.5)
_ONE = np.float32(1.0)


@functools.cache
def blend_backward_kernel(wanted: Wanted) -> Any:
    """Return a kernel that writes the gradient row (splats.py) of each intersection i to rows[isect_rows[i]].

    It uses a block of THREADS per tile. `wanted` are the planes with a gradient; see
    `backend.raster.cpu.blending_backward.blend_backward`.
    """
    flat, want_labels, want_depth, _, want_normals, want_moments = wanted
    stride = staged_columns(flat)
    counted = G_NORMAL + 3 if want_normals else MSY + 1 if flat else G_DEPTH + 1
    # A splat's part of shared memory: in the first phase w, the slope and, for discs, 1 / Q of each pixel; later the
    # sums of each lane, with a padding of one number, so that 32 columns lie in 32 different banks.
    kinds = 3 if flat else 2
    splat_floats = max(kinds * THREADS, counted * (WARP + 1))
    # Rows of `pixels`: the gradients of a pixel, kept for the second phase.
    at_depth = 3
    at_normals = at_depth + want_depth
    at_moments = at_normals + 3 * want_normals
    at_origin = at_moments + 2
    kept = at_moments + 3 * want_moments

    @device_function
    def weigh(
        stage, owners, base, count, thread, x, y, label, g_alpha, g_label_probability, pixels, weights, hits, state
    ):
        """First phase, one pixel per thread: write w, slope and 1 / Q of `count` splats to `weights`.

        The splats are in the staged rows from `base` on; hits marks those that are drawn in this warp. state: T, and
        the remaining part of the sum of w dL/dw.
        """
        t, remaining = state
        g_red, g_green, g_blue = pixels[0, thread], pixels[1, thread], pixels[2, thread]
        s = FIRST
        k = base
        while s < count:
            if flat:
                exponent, q, per_q = disc_exponent(stage, k, x, y)
            else:
                exponent = splat_exponent(stage, k, x, y)
            drawn = exponent >= _LOG2_CUT and t >= _TRANSMITTANCE_THRESHOLD
            hit = any_in_warp(drawn)
            if thread % WARP == 0:
                hits[s, thread // WARP] = hit
            w = _ZERO
            slope = _ZERO
            if drawn:
                raw = exp2(exponent)
                alpha = min(raw, _ALPHA_MAX)
                w = alpha * t
                dot = g_red * stage[k, S_RED] + g_green * stage[k, S_GREEN] + g_blue * stage[k, S_BLUE] + g_alpha
                if want_labels:
                    if owners[k] == label:
                        dot += g_label_probability
                if want_depth:
                    z = stage[k, S_DEPTH]
                    if flat:
                        if per_q > _ZERO:
                            z = z * per_q
                    dot += pixels[at_depth, thread] * z
                if want_normals:
                    dot += (
                        pixels[at_normals, thread] * stage[k, S_NORMAL_X]
                        + pixels[at_normals + 1, thread] * stage[k, S_NORMAL_Y]
                        + pixels[at_normals + 2, thread] * stage[k, S_NORMAL_Z]
                    )
                if want_moments:
                    inverse = stage[k, PER_DEPTH] * q
                    if t >= _ONE:
                        pixels[at_origin, thread] = inverse
                    inverse -= pixels[at_origin, thread]
                    dot += inverse * (pixels[at_moments, thread] + inverse * pixels[at_moments + 1, thread])
                clear = _ONE - alpha
                remaining -= w * dot
                # A clamped alpha has no gradient; otherwise alpha is the derivative of the exponential.
                if raw <= _ALPHA_MAX:
                    slope = alpha * (t * dot - remaining * reciprocal(clear))
                t *= clear
            if hit:
                weights[s, thread] = w
                weights[s, THREADS + thread] = slope
                if flat:
                    weights[s, 2 * THREADS + thread] = per_q
            s += NEXT
            k += NEXT
        return t, remaining

    @device_function
    def add_up(stage, k, s, lane, tile_y, warps, pixels, weights, hits):
        """Second phase, one splat per warp: sum the gradient row of splat k over the pixels of this lane."""
        zero = _ZERO
        m0, my, myy, mx, mxy, mxx = zero, zero, zero, zero, zero, zero
        red, green, blue, depth = zero, zero, zero, zero
        mq, mqx, mqy, msx, msy = zero, zero, zero, zero, zero
        nx, ny, nz = zero, zero, zero
        warp = FIRST
        thread = lane
        while warp < warps:
            if not hits[s, warp]:
                warp += NEXT
                thread += np.uint64(WARP)
                continue
            column, row = pixel_of(thread)
            x, y = np.float32(column), np.float32(tile_y + row) + _HALF
            d, dy = offsets(stage, k, x, y)
            w = weights[s, thread]
            slope = weights[s, THREADS + thread]
            red += w * pixels[0, thread]
            green += w * pixels[1, thread]
            blue += w * pixels[2, thread]
            m0 += slope
            if flat:
                per_q = weights[s, 2 * THREADS + thread]
                plane = per_q > zero
                g_q = zero
                q = _ONE
                if plane:
                    q = stage[k, S_Q0] + stage[k, S_QY] * (y - stage[k, ANCHOR]) + stage[k, S_QX] * d
                if want_depth:
                    term = w * pixels[at_depth, thread]
                    if plane:
                        term *= per_q
                        g_q -= term * stage[k, S_DEPTH] * per_q
                    depth += term
                if want_moments:
                    inverse = stage[k, PER_DEPTH] * q
                    twice = _ONE + _ONE
                    term = pixels[at_moments + 1, thread] * (inverse - pixels[at_origin, thread])
                    term = w * stage[k, PER_DEPTH] * (pixels[at_moments, thread] + twice * term)
                    depth -= term * inverse
                    if plane:
                        g_q += term
                if want_normals:
                    nx += w * pixels[at_normals, thread]
                    ny += w * pixels[at_normals + 1, thread]
                    nz += w * pixels[at_normals + 2, thread]
                if plane:
                    fall = (stage[k, ACROSS] * d * d + stage[k, DOWN] * dy * dy) * per_q * per_q
                    slope *= per_q
                    g_q += _TWO_LN2 * fall * slope
                    mq += g_q
                    mqx += g_q * d
                    mqy += g_q * dy
                    slope *= per_q
                else:
                    msx += slope * (x - stage[k, S_SPOT_U])
                    msy += slope * dy
                    slope = zero
            elif want_depth:
                depth += w * pixels[at_depth, thread]
            along = slope * dy
            my += along
            myy += along * dy
            along = slope * d
            mx += along
            mxy += along * dy
            mxx += along * d
            warp += NEXT
            thread += np.uint64(WARP)
        m0 *= _LN2
        my *= _LN2
        myy *= _LN2
        mx *= _LN2
        mxy *= _LN2
        mxx *= _LN2
        msx *= _LN2
        msy *= _LN2
        return m0, my, myy, mx, mxy, mxx, red, green, blue, depth, mq, mqx, mqy, msx, msy, nx, ny, nz

    @device_function
    def store_sums(weights, s, lane, sums):
        """Write a lane's sums to shared memory, for the other lanes of its warp."""
        weights[s, M0 * (WARP + 1) + lane] = sums[0]
        weights[s, MY * (WARP + 1) + lane] = sums[1]
        weights[s, MYY * (WARP + 1) + lane] = sums[2]
        weights[s, MX * (WARP + 1) + lane] = sums[3]
        weights[s, MXY * (WARP + 1) + lane] = sums[4]
        weights[s, MXX * (WARP + 1) + lane] = sums[5]
        weights[s, G_RED * (WARP + 1) + lane] = sums[6]
        weights[s, G_GREEN * (WARP + 1) + lane] = sums[7]
        weights[s, G_BLUE * (WARP + 1) + lane] = sums[8]
        weights[s, G_DEPTH * (WARP + 1) + lane] = sums[9]
        if flat:
            weights[s, MQ * (WARP + 1) + lane] = sums[10]
            weights[s, MQX * (WARP + 1) + lane] = sums[11]
            weights[s, MQY * (WARP + 1) + lane] = sums[12]
            weights[s, MSX * (WARP + 1) + lane] = sums[13]
            weights[s, MSY * (WARP + 1) + lane] = sums[14]
        if want_normals:
            weights[s, G_NORMAL * (WARP + 1) + lane] = sums[15]
            weights[s, (G_NORMAL + 1) * (WARP + 1) + lane] = sums[16]
            weights[s, (G_NORMAL + 2) * (WARP + 1) + lane] = sums[17]

    @device_function
    def total(weights, s, column):
        """Return the sum of a column over the lanes, in a fixed order."""
        a, b = _ZERO, _ZERO
        for lane in range(0, WARP, 2):
            a += weights[s, column * (WARP + 1) + lane]
            b += weights[s, column * (WARP + 1) + lane + 1]
        return a + b

    # Limits registers to allow this number of blocks per multiprocessor; does not cause spilling.
    @cuda_kernel(launch_bounds=(THREADS, 3 if flat else 4))
    def blend_backward(
        splats, tilts, ids, labels, isect_offsets, isect_ids, isect_rows, isect_counts, columns, color, transmittance,
        label_probability, depth, normals, moments, g_color, g_alpha, g_label_probability, g_depth, g_normals,
        g_moments, rows,
    ):  # fmt: skip
        stage = cuda.shared.array((STAGED_BACKWARD, stride), np.float32, alignment=16)
        owners = cuda.shared.array(STAGED_BACKWARD, np.int32)
        pixels = cuda.shared.array((kept, THREADS), np.float32)
        weights = cuda.shared.array((WARPS, splat_floats), np.float32)
        hits = cuda.shared.array((WARPS, WARPS), np.int8)
        height, width = transmittance.shape
        thread = cuda.threadIdx.x
        warp, lane = np.uint32(thread) // np.uint32(WARP), np.uint32(thread) % np.uint32(WARP)
        # Not a compile-time constant, since the unrolled loop over the warps would need too many registers.
        warps = np.uint64(cuda.blockDim.x // WARP)
        tile = cuda.blockIdx.x
        tile_x = np.int32(tile % columns * TILE)
        tile_y = np.int32(tile // columns * TILE)
        x, y = pixel_of(thread)
        px, py = np.int32(tile_x + x), np.int32(tile_y + y)
        label = np.int32(-1)
        t = _ZERO
        remaining = _ZERO
        a_gradient = _ZERO
        w_gradient = _ZERO
        if px < width and py < height:
            t = _ONE
            a_gradient = g_alpha[py, px]
            remaining = (_ONE - transmittance[py, px]) * a_gradient
            for i in range(3):
                g = g_color[i, py, px]
                pixels[i, thread] = g
                remaining += color[i, py, px] * g
            if want_labels:
                label = labels[py, px]
                w_gradient = g_label_probability[py, px]
                remaining += label_probability[py, px] * w_gradient
            if want_depth:
                g = g_depth[py, px]
                pixels[at_depth, thread] = g
                remaining += depth[py, px] * g
            if want_normals:
                for i in range(3):
                    g = g_normals[i, py, px]
                    pixels[at_normals + i, thread] = g
                    remaining += normals[i, py, px] * g
            if want_moments:
                for i in range(2):
                    g = g_moments[i, py, px]
                    pixels[at_moments + i, thread] = g
                    remaining += moments[i, py, px] * g
                pixels[at_origin, thread] = _ZERO
        else:
            for i in range(kept):
                pixels[i, thread] = _ZERO
        state = (t, remaining)
        first, last = isect_offsets[tile], isect_offsets[tile + 1]
        end = first + isect_counts[tile]
        for base in range(first, end, STAGED_BACKWARD):
            here = min(STAGED_BACKWARD, end - base)
            if thread < here:
                n = isect_ids[base + thread]
                owners[thread] = ids[n]
                if flat:
                    stage_disc(splats, tilts, n, tile_x, height, stage, thread)
                else:
                    stage_splat(splats, n, tile_x, height, stage, thread)
            cuda.syncthreads()
            for k in range(0, here, WARPS):
                state = weigh(
                    stage, owners, np.uint64(k), np.uint64(min(WARPS, here - k)), np.uint64(thread), np.float32(x),
                    np.float32(py) + _HALF, label,
                    a_gradient, w_gradient, pixels, weights, hits, state,
                )  # fmt: skip
                cuda.syncthreads()
                if k + warp < here:
                    sums = add_up(
                        stage,
                        np.uint64(k + warp),
                        np.uint64(warp),
                        np.uint64(lane),
                        tile_y,
                        warps,
                        pixels,
                        weights,
                        hits,
                    )
                sync_warp()
                if k + warp < here:
                    store_sums(weights, warp, lane, sums)
                sync_warp()
                if k + warp < here and lane < counted:
                    rows[isect_rows[base + k + warp], lane] = total(weights, warp, lane)
                cuda.syncthreads()
        for isect in range(end + warp, last, WARPS):
            if lane < counted:
                rows[isect_rows[isect], lane] = _ZERO

    return blend_backward
