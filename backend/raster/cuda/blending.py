"""Front-to-back blending of splats in tiles, on a GPU.

Splats are staged in shared memory (staging.py). A specialized kernel is compiled for each combination of requested
planes.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from numba import cuda

from ..settings import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_THRESHOLD
from .binning import TILE
from .kernel import cuda_kernel, device_function, exp2
from .staging import (
    FIRST,
    NEXT,
    PER_DEPTH,
    S_BLUE,
    S_DEPTH,
    S_GREEN,
    S_NORMAL_X,
    S_NORMAL_Y,
    S_NORMAL_Z,
    S_RED,
    THREADS,
    Wanted,
    disc_exponent,
    pixel_of,
    splat_exponent,
    stage_disc,
    stage_splat,
    staged_columns,
)

STAGED = 256
"""Number of splats staged in shared memory at a time."""

_LOG2_CUT = np.float32(math.log2(ALPHA_MIN))
_ALPHA_MAX = np.float32(ALPHA_MAX)
_TRANSMITTANCE_THRESHOLD = np.float32(TRANSMITTANCE_THRESHOLD)
_ZERO = np.float32(0.0)
_HALF = np.float32(0.5)
_ONE = np.float32(1.0)


@functools.cache
def blend_kernel(wanted: Wanted) -> Any:
    """Return a kernel that blends each tile with a block of THREADS; see `backend.raster.cpu.blending.blend`.

    Planes that are not requested are not accessed. isect_counts (T,) int32 receives the number of intersections of each
    tile up to the last one that contributed.
    """
    flat, want_labels, want_depth, want_median, want_normals, want_moments = wanted
    stride = staged_columns(flat)

    @device_function
    def draw(stage, owners, count, x, y, label, state):
        """Blend the staged splats into a pixel.

        state: T, red, green, blue, label_probability, depth, median, the normal (3), the moments (2) and their origin,
        and the number of staged splats up to the last one that contributed.
        """
        t, red, green, blue, label_probability, depth, median, nx, ny, nz, m1, m2, origin, _ = state
        needed = FIRST
        k = FIRST
        while k < count and t >= _TRANSMITTANCE_THRESHOLD:
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
                        label_probability += w
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
        return t, red, green, blue, label_probability, depth, median, nx, ny, nz, m1, m2, origin, needed

    @cuda_kernel(launch_bounds=THREADS)
    def blend(
        splats, tilts, ids, labels, isect_offsets, isect_ids, columns, color, transmittance, label_probability, depth,
        median, normals, moments, isect_counts,
    ):  # fmt: skip
        stage = cuda.shared.array((STAGED, stride), np.float32, alignment=16)
        owners = cuda.shared.array(STAGED, np.int32)
        last_needed = cuda.shared.array(1, np.int32)
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
            last_needed[0] = 0
        zero = _ZERO
        t = zero
        if inside:
            t = _ONE
        state = (t, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, FIRST)
        needed = np.int32(0)
        first, last = isect_offsets[tile], isect_offsets[tile + 1]
        for base in range(first, last, STAGED):
            if not cuda.syncthreads_or(np.int32(state[0] >= _TRANSMITTANCE_THRESHOLD)):
                break
            if base + thread < last:
                n = isect_ids[base + thread]
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
        cuda.atomic.max(last_needed, 0, needed)
        cuda.syncthreads()
        if thread == 0:
            isect_counts[tile] = last_needed[0]
        if not inside:
            return
        transmittance[py, px] = state[0]
        color[0, py, px] = state[1]
        color[1, py, px] = state[2]
        color[2, py, px] = state[3]
        if want_labels:
            label_probability[py, px] = state[4]
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
