"""Blending splats front to back inside tiles, and its gradient, on a GPU.

A block of 256 threads draws a tile of 16x16 pixels, a thread each; a warp has 8x4 of them. Splats are staged through
shared memory. Nothing is added to from two threads, so the same input gives the same bits.

The gradient of a splat is a sum over pixels. Adding it up across a warp for every splat would cost more than all else;
here eight splats are taken at once, one for each warp. First every thread, as a pixel, goes through the eight and
leaves in shared memory how much each weighs there, w, and dL/d(log2 alpha). Then every warp, as a splat, goes through
the pixels with its sums in registers, so that a sum has only 32 parts left.

What is not asked for is not compiled: a kernel is made for each combination that is used.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np
from numba import cuda

from .cuda_bin import TILE
from .cuda_kernel import WARP, any_in_warp, cuda_kernel, device_function, exp2, reciprocal, sync_warp
from .discs import NEAREST, NORMAL_X, NORMAL_Y, NORMAL_Z, Q0, QX, QY, SPOT, SPOT_U
from .settings import ALPHA_MAX, ALPHA_MIN, STOP
from .splats import (
    BLUE,
    DEPTH,
    G_BLUE,
    G_DEPTH,
    G_GREEN,
    G_NORMAL,
    G_RED,
    GREEN,
    LOP,
    M0,
    MQ,
    MQX,
    MQY,
    MSX,
    MSY,
    MX,
    MXX,
    MXY,
    MY,
    MYY,
    RED,
    SLOPE,
    A,
    C,
    U,
    V,
)

THREADS = TILE * TILE
WARPS = THREADS // WARP
STAGED = 256
"""Splats that wait in shared memory to be drawn."""
STAGED_BACKWARD = 64

# Columns of a staged splat: its centre's column within the tile and its row, the row that the column belongs to, and
# what a splat and, of a disc, a tilt holds (splats.py, discs.py).
AT_U, AT_V, ANCHOR, LEAN, ACROSS, DOWN, TOP, S_RED, S_GREEN, S_BLUE, S_DEPTH = range(11)
S_Q0, S_QX, S_QY, S_NEAREST, S_SPOT_U, S_NORMAL_X, S_NORMAL_Y, S_NORMAL_Z, PER_DEPTH = range(11, 20)

_LOG2_CUT = np.float32(math.log2(ALPHA_MIN))
_ALPHA_MAX = np.float32(ALPHA_MAX)
_STOP = np.float32(STOP)
_SPOT = np.float32(SPOT)
_LN2 = np.float32(math.log(2.0))
_TWO_LN2 = np.float32(2.0 * math.log(2.0))
_ZERO = np.float32(0.0)
_HALF = np.float32(0.5)
_ONE = np.float32(1.0)

# Loops over shared memory count without a sign: an index that might be negative costs a test each time.
FIRST = np.uint64(0)
NEXT = np.uint64(1)


class Wanted(NamedTuple):
    """What a picture holds beside its colour; `flat`: it is of discs."""

    flat: bool = False
    labels: bool = False
    depth: bool = False
    median: bool = False
    normals: bool = False
    moments: bool = False


def staged_columns(flat: bool) -> int:
    """Length of a staged row, a multiple of 16 bytes, so that four neighbours are read at once."""
    return 20 if flat else 12


@device_function
def stage_splat(splats, n, tile_x, height, stage, k):
    """Put splat n into row k of `stage`."""
    v = splats[n, V]
    stage[k, AT_U] = splats[n, U] - _HALF - np.float32(tile_x)
    stage[k, AT_V] = v
    stage[k, ANCHOR] = min(max(v, _ZERO), np.float32(height))
    stage[k, LEAN] = splats[n, SLOPE]
    stage[k, ACROSS] = splats[n, A]
    stage[k, DOWN] = splats[n, C]
    stage[k, TOP] = splats[n, LOP]
    stage[k, S_RED] = splats[n, RED]
    stage[k, S_GREEN] = splats[n, GREEN]
    stage[k, S_BLUE] = splats[n, BLUE]
    stage[k, S_DEPTH] = splats[n, DEPTH]


@device_function
def stage_disc(splats, tilts, n, tile_x, height, stage, k):
    """Put disc n into row k of `stage`."""
    stage_splat(splats, n, tile_x, height, stage, k)
    stage[k, S_Q0] = tilts[n, Q0]
    stage[k, S_QX] = tilts[n, QX]
    stage[k, S_QY] = tilts[n, QY]
    stage[k, S_NEAREST] = tilts[n, NEAREST]
    stage[k, S_SPOT_U] = tilts[n, SPOT_U] - _HALF - np.float32(tile_x)
    stage[k, S_NORMAL_X] = tilts[n, NORMAL_X]
    stage[k, S_NORMAL_Y] = tilts[n, NORMAL_Y]
    stage[k, S_NORMAL_Z] = tilts[n, NORMAL_Z]
    stage[k, PER_DEPTH] = _ONE / splats[n, DEPTH]


@device_function
def offsets(stage, k, x, y):
    """From the ridge of a splat, across, and from its centre, down, to the pixel in column x (0 to 15) of the tile with
    its centre at height y."""
    return x - (stage[k, AT_U] + stage[k, LEAN] * (y - stage[k, ANCHOR])), y - stage[k, AT_V]


@device_function
def splat_exponent(stage, k, x, y):
    """log2 alpha of a 3D Gaussian in a pixel, unclamped."""
    d, dy = offsets(stage, k, x, y)
    return stage[k, TOP] - stage[k, DOWN] * dy * dy - stage[k, ACROSS] * d * d


@device_function
def disc_exponent(stage, k, x, y):
    """log2 alpha of a disc in a pixel, unclamped; Q, and 1 / Q where the disc's plane is drawn, 0 where its spot is."""
    d, dy = offsets(stage, k, x, y)
    q = stage[k, S_Q0] + stage[k, S_QY] * (y - stage[k, ANCHOR]) + stage[k, S_QX] * d
    per_q = reciprocal(q)
    fall = (stage[k, ACROSS] * d * d + stage[k, DOWN] * dy * dy) * per_q * per_q
    ds = x - stage[k, S_SPOT_U]
    spot_fall = _SPOT * (ds * ds + dy * dy)
    # False where Q = 0 and the fall is not a number.
    if per_q >= stage[k, S_NEAREST] and spot_fall > fall:
        return stage[k, TOP] - fall, q, per_q
    return stage[k, TOP] - spot_fall, _ONE, _ZERO


@device_function
def pixel_of(thread):
    """Column and row in the tile of a thread's pixel."""
    lane = thread % WARP
    warp = thread // WARP
    return np.int32(lane % 8 + warp % 2 * 8), np.int32(lane // 8 + warp // 2 * 4)


@functools.cache
def blend_kernel(wanted: Wanted) -> Any:
    """Kernel with a block of THREADS for each tile that draws; see `cpu_tiles.blend` for what the planes hold.

    Planes that are not wanted are not touched. ends (T,) int32: how many members of each tile were needed.
    """
    flat, want_labels, want_depth, want_median, want_normals, want_moments = wanted
    stride = staged_columns(flat)

    @device_function
    def draw(stage, owners, count, x, y, label, state):
        """Blend the staged splats into a pixel. The state: T, red, green, blue, weight, depth, median, three of the
        normal, two moments and their origin, and how many of the staged splats were needed."""
        t, red, green, blue, weight, depth, median, nx, ny, nz, m1, m2, origin, _ = state
        needed = FIRST
        k = FIRST
        while k < count and t >= _STOP:
            if flat:
                exponent, q, per_q = disc_exponent(stage, k, x, y)
            else:
                exponent = splat_exponent(stage, k, x, y)
            if exponent >= _LOG2_CUT:
                needed = k + NEXT
                alpha = min(exp2(exponent), _ALPHA_MAX)
                w = alpha * t
                after = t * (_ONE - alpha)
                red += w * stage[k, S_RED]
                green += w * stage[k, S_GREEN]
                blue += w * stage[k, S_BLUE]
                if want_labels:
                    if owners[k] == label:
                        weight += w
                if want_depth or want_median:
                    z = stage[k, S_DEPTH]
                    if flat:
                        if per_q > _ZERO:
                            z = z * per_q
                    if want_depth:
                        depth += w * z
                    if want_median:
                        if t >= _HALF and after < _HALF:
                            median = z
                if want_normals:
                    nx += w * stage[k, S_NORMAL_X]
                    ny += w * stage[k, S_NORMAL_Y]
                    nz += w * stage[k, S_NORMAL_Z]
                if want_moments:
                    inverse = stage[k, PER_DEPTH] * q
                    if t >= _ONE:
                        origin = inverse
                    inverse -= origin
                    m1 += w * inverse
                    m2 += w * inverse * inverse
                t = after
            k += NEXT
        return t, red, green, blue, weight, depth, median, nx, ny, nz, m1, m2, origin, needed

    @cuda_kernel(launch_bounds=THREADS)
    def blend(
        splats, tilts, ids, labels, starts, members, columns, color, transmittance, weight, depth, median, normals,
        moments, ends,
    ):  # fmt: skip
        stage = cuda.shared.array((STAGED, stride), np.float32, alignment=16)
        owners = cuda.shared.array(STAGED, np.int32)
        furthest = cuda.shared.array(1, np.int32)
        height, width = transmittance.shape
        thread = cuda.threadIdx.x
        tile = cuda.blockIdx.x
        tile_x = np.int32(tile % columns * TILE)
        tile_y = np.int32(tile // columns * TILE)
        x, y = pixel_of(thread)
        px, py = np.int32(tile_x + x), np.int32(tile_y + y)
        inside = px < width and py < height
        label = np.int32(-1)
        if want_labels and inside:
            label = labels[py, px]
        if thread == 0:
            furthest[0] = 0
        zero = _ZERO
        t = zero
        if inside:
            t = _ONE
        state = (t, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, FIRST)
        needed = np.int32(0)
        first, last = starts[tile], starts[tile + 1]
        for base in range(first, last, STAGED):
            if not cuda.syncthreads_or(np.int32(state[0] >= _STOP)):
                break
            if base + thread < last:
                n = members[base + thread]
                owners[thread] = ids[n]
                if flat:
                    stage_disc(splats, tilts, n, tile_x, height, stage, thread)
                else:
                    stage_splat(splats, n, tile_x, height, stage, thread)
            cuda.syncthreads()
            count = np.uint64(min(STAGED, last - base))
            state = draw(stage, owners, count, np.float32(x), np.float32(py) + _HALF, label, state)
            if state[13] > FIRST:
                needed = np.int32(base - first + np.int64(state[13]))
        cuda.syncthreads()
        cuda.atomic.max(furthest, 0, needed)
        cuda.syncthreads()
        if thread == 0:
            ends[tile] = furthest[0]
        if not inside:
            return
        transmittance[py, px] = state[0]
        color[0, py, px] = state[1]
        color[1, py, px] = state[2]
        color[2, py, px] = state[3]
        if want_labels:
            weight[py, px] = state[4]
        if want_depth:
            depth[py, px] = state[5]
        if want_median:
            median[py, px] = state[6]
        if want_normals:
            normals[0, py, px] = state[7]
            normals[1, py, px] = state[8]
            normals[2, py, px] = state[9]
        if want_moments:
            moments[0, py, px] = state[10]
            moments[1, py, px] = state[11]

    return blend


@functools.cache
def blend_backward_kernel(wanted: Wanted) -> Any:
    """Kernel with a block of THREADS for each tile that writes rows[places[i]] for every meeting i of a tile and a
    splat: the gradient row of splats.py. Wanted are the planes with a gradient; see `cpu_tiles.blend_backward`."""
    flat, want_labels, want_depth, _, want_normals, want_moments = wanted
    stride = staged_columns(flat)
    counted = G_NORMAL + 3 if want_normals else MSY + 1 if flat else G_DEPTH + 1
    # A splat's part of shared memory: w, the slope and of discs 1 / Q of every pixel; then the sums of every lane, and
    # one number between them, so that 32 columns lie in 32 banks.
    kinds = 3 if flat else 2
    room = max(kinds * THREADS, counted * (WARP + 1))
    # What a pixel's gradients are kept in for the second half.
    at_depth = 3
    at_normals = at_depth + want_depth
    at_moments = at_normals + 3 * want_normals
    at_origin = at_moments + 2
    kept = at_moments + 3 * want_moments

    @device_function
    def weigh(stage, owners, base, count, thread, x, y, label, g_alpha, g_weight, pixels, pairs, hits, state):
        """As a pixel: w, slope and 1 / Q of `count` splats from staged row `base` on, into `pairs`; hits says of which
        splats there is any in this warp. state: T, and what is still to come of sum w dL/dw."""
        t, remaining = state
        g_red, g_green, g_blue = pixels[0, thread], pixels[1, thread], pixels[2, thread]
        s = FIRST
        k = base
        while s < count:
            if flat:
                exponent, q, per_q = disc_exponent(stage, k, x, y)
            else:
                exponent = splat_exponent(stage, k, x, y)
            drawn = exponent >= _LOG2_CUT and t >= _STOP
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
                        dot += g_weight
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
                # Where alpha was clamped it has no gradient; else it is the exponential's own derivative.
                if raw <= _ALPHA_MAX:
                    slope = alpha * (t * dot - remaining * reciprocal(clear))
                t *= clear
            if hit:
                pairs[s, thread] = w
                pairs[s, THREADS + thread] = slope
                if flat:
                    pairs[s, 2 * THREADS + thread] = per_q
            s += NEXT
            k += NEXT
        return t, remaining

    @device_function
    def add_up(stage, k, s, lane, tile_y, warps, pixels, pairs, hits):
        """As a lane of splat k's warp: its gradient row over the pixels that this lane goes through."""
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
            w = pairs[s, thread]
            slope = pairs[s, THREADS + thread]
            red += w * pixels[0, thread]
            green += w * pixels[1, thread]
            blue += w * pixels[2, thread]
            m0 += slope
            if flat:
                per_q = pairs[s, 2 * THREADS + thread]
                plane = per_q > zero
                g_q = zero
                q = _ONE
                if plane:
                    q = stage[k, S_Q0] + stage[k, S_QY] * (y - stage[k, ANCHOR]) + stage[k, S_QX] * d
                if want_depth:
                    share = w * pixels[at_depth, thread]
                    if plane:
                        share *= per_q
                        g_q -= share * stage[k, S_DEPTH] * per_q
                    depth += share
                if want_moments:
                    inverse = stage[k, PER_DEPTH] * q
                    twice = _ONE + _ONE
                    share = pixels[at_moments + 1, thread] * (inverse - pixels[at_origin, thread])
                    share = w * stage[k, PER_DEPTH] * (pixels[at_moments, thread] + twice * share)
                    depth -= share * inverse
                    if plane:
                        g_q += share
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
    def share_sums(pairs, s, lane, sums):
        """Leave a lane's sums where the other lanes of its warp find them."""
        pairs[s, M0 * (WARP + 1) + lane] = sums[0]
        pairs[s, MY * (WARP + 1) + lane] = sums[1]
        pairs[s, MYY * (WARP + 1) + lane] = sums[2]
        pairs[s, MX * (WARP + 1) + lane] = sums[3]
        pairs[s, MXY * (WARP + 1) + lane] = sums[4]
        pairs[s, MXX * (WARP + 1) + lane] = sums[5]
        pairs[s, G_RED * (WARP + 1) + lane] = sums[6]
        pairs[s, G_GREEN * (WARP + 1) + lane] = sums[7]
        pairs[s, G_BLUE * (WARP + 1) + lane] = sums[8]
        pairs[s, G_DEPTH * (WARP + 1) + lane] = sums[9]
        if flat:
            pairs[s, MQ * (WARP + 1) + lane] = sums[10]
            pairs[s, MQX * (WARP + 1) + lane] = sums[11]
            pairs[s, MQY * (WARP + 1) + lane] = sums[12]
            pairs[s, MSX * (WARP + 1) + lane] = sums[13]
            pairs[s, MSY * (WARP + 1) + lane] = sums[14]
        if want_normals:
            pairs[s, G_NORMAL * (WARP + 1) + lane] = sums[15]
            pairs[s, (G_NORMAL + 1) * (WARP + 1) + lane] = sums[16]
            pairs[s, (G_NORMAL + 2) * (WARP + 1) + lane] = sums[17]

    @device_function
    def total(pairs, s, column):
        """Sum of a column over the lanes, always in the same order."""
        a, b = _ZERO, _ZERO
        for lane in range(0, WARP, 2):
            a += pairs[s, column * (WARP + 1) + lane]
            b += pairs[s, column * (WARP + 1) + lane + 1]
        return a + b

    # Registers for so many blocks on a processor at least; none is spilled for it.
    @cuda_kernel(launch_bounds=(THREADS, 3 if flat else 4))
    def blend_backward(
        splats, tilts, ids, labels, starts, members, places, ends, columns, color, transmittance, weight, depth,
        normals, moments, g_color, g_alpha, g_weight, g_depth, g_normals, g_moments, rows,
    ):  # fmt: skip
        stage = cuda.shared.array((STAGED_BACKWARD, stride), np.float32, alignment=16)
        owners = cuda.shared.array(STAGED_BACKWARD, np.int32)
        pixels = cuda.shared.array((kept, THREADS), np.float32)
        pairs = cuda.shared.array((WARPS, room), np.float32)
        hits = cuda.shared.array((WARPS, WARPS), np.int8)
        height, width = transmittance.shape
        thread = cuda.threadIdx.x
        warp, lane = np.uint32(thread) // np.uint32(WARP), np.uint32(thread) % np.uint32(WARP)
        # Not known when this is compiled: the loop over them, unrolled, would need too many registers.
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
                w_gradient = g_weight[py, px]
                remaining += weight[py, px] * w_gradient
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
        first, last = starts[tile], starts[tile + 1]
        end = first + ends[tile]
        for base in range(first, end, STAGED_BACKWARD):
            here = min(STAGED_BACKWARD, end - base)
            if thread < here:
                n = members[base + thread]
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
                    a_gradient, w_gradient, pixels, pairs, hits, state,
                )  # fmt: skip
                cuda.syncthreads()
                if k + warp < here:
                    sums = add_up(
                        stage, np.uint64(k + warp), np.uint64(warp), np.uint64(lane), tile_y, warps, pixels, pairs, hits
                    )
                sync_warp()
                if k + warp < here:
                    share_sums(pairs, warp, lane, sums)
                sync_warp()
                if k + warp < here and lane < counted:
                    rows[places[base + k + warp], lane] = total(pairs, warp, lane)
                cuda.syncthreads()
        for meeting in range(end + warp, last, WARPS):
            if lane < counted:
                rows[places[meeting], lane] = _ZERO

    return blend_backward
