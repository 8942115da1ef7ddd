"""PatchMatch stereo: planes on which patches of a photo look the same in its neighbors, with known poses.

The surface around a pixel is taken as a plane, whose inverse depth is affine in the pixel: 1 / z = w + a du + b dv. The
correlation of a patch with those that the plane maps it to is maximized by trying fronto-parallel planes first, then
the planes of nearby pixels and random changes (Barnes et al. 2009; Bleyer, Rhemann and Rother 2011). A patch is small,
so the homography is taken as affine in it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from scipy import ndimage

from ..raster import simd
from ..raster.kernel import kernel

RADIUS = 4
"""Radius of the patches in pixels."""
DEPTHS = 32
"""Number of fronto-parallel planes that are tried first, at equal steps of the inverse depth."""
ROUNDS = 8
"""Number of rounds in which planes spread."""
STEEPEST = 4.0
"""Largest slope of a plane against the image plane."""
_FLATTEST = 1.5
"""Least standard deviation of a patch in gray levels; patches with less are not matched."""
_SIMILAR = np.float32(20.0)
"""Difference in gray levels from the middle pixel at which a pixel of a patch weighs 1 / e: a patch across the border
of an object is matched by the side that its middle is on."""
_ASIDE, _DISTINCT = np.float32(0.1), np.float32(0.1)
"""Relative difference of the depth at which a patch must correlate less than on a given plane, and by how much. Smooth
shades, as of the sky, correlate at any depth."""
_TRIALS = 6
"""Number of random changes in a round."""
_SMALLEST, _LARGEST = np.float32(0.08), np.float32(12.0)
"""Range of the area of a pixel in another photo."""
_AROUND = np.array([(0, 1), (0, -1), (1, 0), (-1, 0), (0, 3), (0, -3), (3, 0), (-3, 0)])
"""Rows and columns from a pixel of the grid to those whose planes it tries."""

_SIDE = 2 * RADIUS + 1
_PADDED = -(-(_SIDE**2) // simd.LANES) * simd.LANES
"""Number of pixels of a patch, rounded up; the additional ones are its middle, without any weight."""
_RIGHT, _DOWN = np.zeros((2, _PADDED), np.float32)
_DOWN[: _SIDE**2], _RIGHT[: _SIDE**2] = np.indices((_SIDE, _SIDE)).reshape(2, -1) - RADIUS
"""Columns and rows of the pixels of a patch from its middle."""


class Others(NamedTuple):
    """The photos that a photo is matched with.

    A pixel (u, v) with the inverse depth w is at (turns (u, v, 1) + w steps) in them, up to scale.

    Attributes:
        turns: (k, 3, 3) float32.
        steps: (k, 3) float32.
        images: (k, H, W) int32, see `packed`.
        sizes: (k, 2) int64 heights and widths that are used of them.
    """

    turns: np.ndarray
    steps: np.ndarray
    images: np.ndarray
    sizes: np.ndarray


def packed(image: np.ndarray) -> np.ndarray:
    """Return gray levels (H, W) with their neighbors, int32.

    The bytes of a pixel, from the lowest, are the rounded levels of itself and of those to the right, below, and to the
    right below, so that a level between four pixels takes one access to the memory.
    """
    levels = np.pad(np.clip(np.rint(image), 0, 255).astype(np.uint8), ((0, 1), (0, 1)), "edge")
    four = np.stack([levels[:-1, :-1], levels[:-1, 1:], levels[1:, :-1], levels[1:, 1:]], -1)
    return np.ascontiguousarray(four).view("<i4")[..., 0].astype(np.int32)


class Matches(NamedTuple):
    """The planes of the pixels of a grid.

    Attributes:
        planes: (n, 3) float32, inverse depth of the pixel, and its difference to the next pixel to the right and below.
        scores: (n,) float32, the mean of the two best correlations; -1 where none was found.
    """

    planes: np.ndarray
    scores: np.ndarray


def match(
    image: np.ndarray, pixels: np.ndarray, columns: int, others: Others, nearest: float, farthest: float, focal: float
) -> Matches:
    """Match the patches around pixels with other photos.

    Args:
        image: (H, W) int32 gray levels, see `packed`.
        pixels: (n, 2) int64 columns and rows of a regular grid, row by row.
        columns: number of columns of the grid.
        others: at least one other photo.
        nearest, farthest: range of the depths.
        focal: focal length in pixels.

    Returns:
        The planes; the same ones for any number of threads.
    """
    inverse = np.linspace(1.0 / farthest, 1.0 / nearest, DEPTHS).astype(np.float32)
    planes, scores = np.zeros((len(pixels), 3), np.float32), np.full(len(pixels), -1.0, np.float32)
    levels = (image & 255).astype(np.float32)
    textured = _deviation(levels)[pixels[:, 1], pixels[:, 0]] >= _FLATTEST
    _sweep(levels, pixels, textured, *others, inverse, planes, scores)
    stride = int(pixels[1, 0] - pixels[0, 0]) if columns > 1 else 1
    for turn in range(ROUNDS):
        planes, scores = _spread(
            levels, pixels, textured, *others, planes, scores, columns, stride, inverse, np.float32(STEEPEST / focal),
            turn,
        )  # fmt: skip
    return Matches(planes, scores)


def match_planes(
    image: np.ndarray, pixels: np.ndarray, others: Others, planes: np.ndarray, allowed: np.ndarray
) -> Matches:
    """Match the patches around pixels with other photos, on given planes alone.

    Args:
        image, pixels, others: as in `match`.
        planes: (p, 3) float64, which have the inverse depth p . (u, v, 1) at (u, v).
        allowed: (n, p) bool, the planes to try for each pixel.

    Returns:
        The plane of each pixel that matches best.
    """
    found, scores = np.zeros((len(pixels), 3), np.float32), np.full(len(pixels), -1.0, np.float32)
    levels = (image & 255).astype(np.float32)
    textured = _deviation(levels)[pixels[:, 1], pixels[:, 0]] >= _FLATTEST
    _try_planes(levels, pixels, allowed & textured[:, None], *others, planes, found, scores)
    return Matches(found, scores)


def _deviation(image: np.ndarray) -> np.ndarray:
    """Return the standard deviation of the patch around each pixel, (H, W)."""
    exact, side = image.astype(np.float64), 2 * RADIUS + 1
    mean = ndimage.uniform_filter(exact, side)
    return np.sqrt(np.maximum(ndimage.uniform_filter(exact**2, side) - mean**2, 0.0))


@kernel(fastmath=True)
def _read_patch(image, column, row, turns):  # type: ignore[no-untyped-def]
    """Return what the correlation of a patch with others needs.

    Returns:
        Its values (_PADDED,) less their weighted mean, their weights, which sum to 1, their standard deviation, the
        direction of its middle pixel in the other photos (k, 3), and its change to the right and below (k, 2, 3).
    """
    values, weights = np.zeros(_PADDED, np.float32), np.zeros(_PADDED, np.float32)
    total, mean, square = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for i in range(_SIDE**2):
        value = image[row + int(_DOWN[i]), column + int(_RIGHT[i])]
        weight = np.exp(-abs(value - image[row, column]) / _SIMILAR)
        values[i], weights[i] = value, weight
        total += weight
        mean += weight * value
    mean /= total
    for i in range(_SIDE**2):
        weights[i] /= total
        values[i] -= mean
        square += weights[i] * values[i] * values[i]
    deviation = np.sqrt(max(square, np.float32(1e-6)))
    middle, beside = np.empty((len(turns), 3), np.float32), np.empty((len(turns), 2, 3), np.float32)
    u, v = np.float32(column + 0.5), np.float32(row + 0.5)
    for k in range(len(turns)):
        for axis in range(3):
            middle[k, axis] = turns[k, axis, 0] * u + turns[k, axis, 1] * v + turns[k, axis, 2]
            beside[k, 0, axis], beside[k, 1, axis] = turns[k, axis, 0], turns[k, axis, 1]
    return values, weights, deviation, middle, beside


@kernel(fastmath=True)
def _score(values, weights, deviation, middle, beside, steps, images, sizes, w, a, b):  # type: ignore[no-untyped-def]
    """Return the mean of the two best correlations of a patch with other photos; with one photo, its correlation."""
    radius, edge, half = np.float32(RADIUS), np.float32(0.01), np.float32(0.5)
    packed, width = images.reshape(-1), simd.splat(np.float32(images.shape[2]))
    first, second = np.float32(-1.0), np.float32(-1.0)
    for k in range(len(steps)):
        z = middle[k, 2] + steps[k, 2] * w
        if z <= np.float32(1e-9):
            continue
        u, v = (middle[k, 0] + steps[k, 0] * w) / z, (middle[k, 1] + steps[k, 1] * w) / z
        right, below = beside[k, 0, 2] + steps[k, 2] * a, beside[k, 1, 2] + steps[k, 2] * b
        ux = (beside[k, 0, 0] + steps[k, 0] * a - u * right) / z
        vx = (beside[k, 0, 1] + steps[k, 1] * a - v * right) / z
        uy = (beside[k, 1, 0] + steps[k, 0] * b - u * below) / z
        vy = (beside[k, 1, 1] + steps[k, 1] * b - v * below) / z
        area = ux * vy - uy * vx
        if area < _SMALLEST or area > _LARGEST:
            continue
        across, down = radius * (abs(ux) + abs(uy)), radius * (abs(vx) + abs(vy))
        u, v = u - half, v - half
        if min(u - across, v - down) < edge:
            continue
        if u + across > sizes[k, 1] - 1 - edge or v + down > sizes[k, 0] - 1 - edge:
            continue
        begin = k * images.shape[1] * images.shape[2]
        total, squares, product = simd.splat(np.float32(0.0)), simd.splat(np.float32(0.0)), simd.splat(np.float32(0.0))
        for i in range(0, _PADDED, simd.LANES):
            x = simd.splat(u) + simd.load(_RIGHT, i) * simd.splat(ux) + simd.load(_DOWN, i) * simd.splat(uy)
            y = simd.splat(v) + simd.load(_RIGHT, i) * simd.splat(vx) + simd.load(_DOWN, i) * simd.splat(vy)
            column, row = simd.whole(x), simd.whole(y)
            # Exact, since a photo has fewer than 2**24 pixels.
            four = simd.gather_i(packed, begin, simd.truncate(row * width + column))
            left = simd.byte(four, 0)
            upper = left + (x - column) * (simd.byte(four, 1) - left)
            left = simd.byte(four, 2)
            lower = left + (x - column) * (simd.byte(four, 3) - left)
            seen = upper + (y - row) * (lower - upper)
            weighted = simd.load(weights, i) * seen
            total = total + weighted
            squares = squares + weighted * seen
            product = product + weighted * simd.load(values, i)
        mean = simd.total(total)
        square = simd.total(squares) - mean * mean
        if square > np.float32(0.25):
            correlation = simd.total(product) / (deviation * np.sqrt(square))
            if correlation > first:
                first, second = correlation, first
            elif correlation > second:
                second = correlation
    return first if len(steps) == 1 else np.float32(0.5) * (first + second)


@kernel(parallel=True, fastmath=True)
def _sweep(image, pixels, textured, turns, steps, images, sizes, inverse, planes, scores):  # type: ignore[no-untyped-def]
    """Try fronto-parallel planes; fills the best planes (n, 3) and scores (n,)."""
    flat = np.float32(0.0)
    for n in prange(len(pixels)):
        if not textured[n]:
            continue
        values, weights, deviation, middle, beside = _read_patch(image, pixels[n, 0], pixels[n, 1], turns)
        for w in inverse:
            score = _score(values, weights, deviation, middle, beside, steps, images, sizes, w, flat, flat)
            if score > scores[n]:
                scores[n], planes[n, 0] = score, w


@kernel(parallel=True, fastmath=True)
def _try_planes(image, pixels, allowed, turns, steps, images, sizes, planes, found, scores):  # type: ignore[no-untyped-def]
    """Try given planes (p, 3) where they are allowed (n, p); fills the best planes (n, 3) and scores (n,)."""
    for n in prange(len(pixels)):
        if not allowed[n].any():
            continue
        values, weights, deviation, middle, beside = _read_patch(image, pixels[n, 0], pixels[n, 1], turns)
        for p in range(len(planes)):
            if not allowed[n, p]:
                continue
            w = planes[p, 0] * (pixels[n, 0] + 0.5) + planes[p, 1] * (pixels[n, 1] + 0.5) + planes[p, 2]
            near, a, b = np.float32(w), np.float32(planes[p, 0]), np.float32(planes[p, 1])
            score = _score(values, weights, deviation, middle, beside, steps, images, sizes, near, a, b)
            if score > scores[n]:
                scores[n], found[n, 0], found[n, 1], found[n, 2] = score, near, a, b
        for factor in (np.float32(1.0) - _ASIDE, np.float32(1.0) + _ASIDE):
            near, a, b = factor * found[n, 0], factor * found[n, 1], factor * found[n, 2]
            aside = _score(values, weights, deviation, middle, beside, steps, images, sizes, near, a, b)
            if aside > scores[n] - _DISTINCT:
                scores[n] = -1.0


@kernel(parallel=True, fastmath=True)
def _spread(  # type: ignore[no-untyped-def]
    image, pixels, textured, turns, steps, images, sizes, planes, scores, columns, stride, inverse, tilt, turn
):
    """Try the planes of nearby pixels and random changes, which become smaller each turn; return planes and scores."""
    new, new_scores = planes.copy(), scores.copy()
    rows = len(pixels) // columns
    least, most = inverse[0], inverse[-1]
    step = np.float32(2.0) * (inverse[1] - inverse[0]) * np.float32(0.5) ** turn
    lean = tilt * np.float32(0.5) ** turn
    for n in prange(len(pixels)):
        if not textured[n]:
            continue
        values, weights, deviation, middle, beside = _read_patch(image, pixels[n, 0], pixels[n, 1], turns)
        row, column = n // columns, n % columns
        best, top = planes[n].copy(), scores[n]
        for t in range(len(_AROUND)):
            down, right = _AROUND[t, 0], _AROUND[t, 1]
            m = n + down * columns + right
            if not (0 <= row + down < rows and 0 <= column + right < columns) or scores[m] <= -1.0:
                continue
            a, b = planes[m, 1], planes[m, 2]
            w = planes[m, 0] - stride * (a * right + b * down)
            if w < least or w > most:
                continue
            score = _score(values, weights, deviation, middle, beside, steps, images, sizes, w, a, b)
            if score > top:
                top, best[0], best[1], best[2] = score, w, a, b
        seed = np.uint32(n * 2654435761 + turn * 40503 + 12345)
        for t in range(_TRIALS):
            w, a, b = best[0], best[1], best[2]
            seed, change = _random(seed)
            if t % 3 != 1:
                w += change * step
            if t % 3 != 0:
                seed, change = _random(seed)
                a += change * lean * best[0]
                seed, change = _random(seed)
                b += change * lean * best[0]
            if w < least or w > most or abs(a) > tilt * w or abs(b) > tilt * w:
                continue
            score = _score(values, weights, deviation, middle, beside, steps, images, sizes, w, a, b)
            if score > top:
                top, best[0], best[1], best[2] = score, w, a, b
        new[n], new_scores[n] = best, top
    return new, new_scores


@kernel()
def _random(seed):  # type: ignore[no-untyped-def]
    """Return the next seed and a number in [-1, 1) (xorshift, Marsaglia 2003)."""
    seed = np.uint32(seed ^ (seed << np.uint32(13)))
    seed = np.uint32(seed ^ (seed >> np.uint32(17)))
    seed = np.uint32(seed ^ (seed << np.uint32(5)))
    return seed, np.float32(seed) / np.float32(2147483648.0) - np.float32(1.0)
