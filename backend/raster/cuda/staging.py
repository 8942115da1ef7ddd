"""Common parts of the CUDA blending kernels: splats staged in shared memory, and their log2 alpha in a pixel.

A block of 256 threads draws a tile of 16x16 pixels, one thread per pixel; a warp draws 8x4 pixels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..discs import NEAREST, NORMAL_X, NORMAL_Y, NORMAL_Z, Q0, QX, QY, SPOT, SPOT_U
from ..splats import BLUE, DEPTH, GREEN, LOP, RED, SLOPE, A, C, U, V
from .binning import TILE
from .kernel import WARP, device_function, reciprocal

THREADS = TILE * TILE

# Columns of a staged splat: its column U relative to the tile, the row of its center, the row that U refers to, and the
# other values of a splat and, for discs, of a tilt (splats.py, discs.py).
AT_U, AT_V, ANCHOR, LEAN, ACROSS, DOWN, TOP, S_RED, S_GREEN, S_BLUE, S_DEPTH = range(11)
S_Q0, S_QX, S_QY, S_NEAREST, S_SPOT_U, S_NORMAL_X, S_NORMAL_Y, S_NORMAL_Z, PER_DEPTH = range(11, 20)

_SPOT = np.float32(SPOT)
_ZERO = np.float32(0.0)
_HALF = np.float32(0.5)
_ONE = np.float32(1.0)

# Loops over shared memory use unsigned counters, since numba tests signed indices for negative values.
FIRST = np.uint64(0)
NEXT = np.uint64(1)


class Wanted(NamedTuple):
    """The planes requested in addition to color and transmittance; `flat`: discs instead of 3D Gaussians."""

    flat: bool = False
    labels: bool = False
    depth: bool = False
    median: bool = False
    normals: bool = False
    moments: bool = False


def staged_columns(flat: bool) -> int:
    """Return the number of columns of a staged row, a multiple of 16 bytes, for vectorized loads of four values."""
    return 20 if flat else 12


@device_function
def stage_splat(splats, n, tile_x, height, stage, k):
    """Write splat n to row k of `stage`."""
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
    """Write disc n to row k of `stage`."""
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
    """Return the horizontal distance of a pixel from the ridge of a splat, and the vertical distance from its center.

    x: the pixel's column in the tile (0 to 15); y: the row of its center in the image.
    """
    return x - (stage[k, AT_U] + stage[k, LEAN] * (y - stage[k, ANCHOR])), y - stage[k, AT_V]


@device_function
def splat_exponent(stage, k, x, y):
    """Return log2 alpha of a 3D Gaussian in a pixel, unclamped."""
    d, dy = offsets(stage, k, x, y)
    return stage[k, TOP] - stage[k, DOWN] * dy * dy - stage[k, ACROSS] * d * d


@device_function
def disc_exponent(stage, k, x, y):
    """Return log2 alpha of a disc in a pixel, unclamped; Q; and 1 / Q where its plane is drawn, 0 where its spot is."""
    d, dy = offsets(stage, k, x, y)
    q = stage[k, S_Q0] + stage[k, S_QY] * (y - stage[k, ANCHOR]) + stage[k, S_QX] * d
    per_q = reciprocal(q)
    fall = (stage[k, ACROSS] * d * d + stage[k, DOWN] * dy * dy) * per_q * per_q
    ds = x - stage[k, S_SPOT_U]
    spot_fall = _SPOT * (ds * ds + dy * dy)
    # False if Q = 0, for which `fall` is NaN.
    if per_q >= stage[k, S_NEAREST] and spot_fall > fall:
        return stage[k, TOP] - fall, q, per_q
    return stage[k, TOP] - spot_fall, _ONE, _ZERO


@device_function
def pixel_of(thread):
    """Return the column and row of a thread's pixel in the tile."""
    lane = thread % WARP
    warp = thread // WARP
    return np.int32(lane % 8 + warp % 2 * 8), np.int32(lane // 8 + warp // 2 * 4)
