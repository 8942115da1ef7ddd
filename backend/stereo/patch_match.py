"""PatchMatch stereo: planes on which patches of a photo look the same in its neighbors, with known poses.

The surface around a pixel is taken as a plane, whose inverse depth is affine in the pixel: 1 / z = w + a du + b dv. The
correlation of a patch with those that the plane maps it to is maximized by trying fronto-parallel planes first, then
the planes of nearby pixels and random changes (Barnes et al. 2009; Bleyer, Rhemann and Rother 2011). A patch is small,
so the homography is taken as affine in it.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from scipy import ndimage

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


class Others(NamedTuple):
    """The photos that a photo is matched with.

    A pixel (u, v) with the inverse depth w is at (turns (u, v, 1) + w steps) in them, up to scale.

    Attributes:
        turns: (k, 3, 3) float32.
        steps: (k, 3) float32.
        images: (k, H, W) float32 gray levels.
        sizes: (k, 2) int64 heights and widths that are used of them.
    """

    turns: np.ndarray
    steps: np.ndarray
    images: np.ndarray
    sizes: np.ndarray


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
        image: (H, W) float32 gray levels.
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
    textured = _deviation(image)[pixels[:, 1], pixels[:, 0]] >= _FLATTEST
    image = np.ascontiguousarray(image, np.float32)
    _sweep(image, pixels, textured, *others, inverse, planes, scores)
    stride = int(pixels[1, 0] - pixels[0, 0]) if columns > 1 else 1
    for turn in range(ROUNDS):
        planes, scores = _spread(
            image, pixels, textured, *others, planes, scores, columns, stride, inverse, np.float32(STEEPEST / focal),
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
    textured = _deviation(image)[pixels[:, 1], pixels[:, 0]] >= _FLATTEST
    image = np.ascontiguousarray(image, np.float32)
    _try_planes(image, pixels, allowed & textured[:, None], *others, planes, found, scores)
    return Matches(found, scores)


def _deviation(image: np.ndarray) -> np.ndarray:
    """Return the standard deviation of the patch around each pixel, (H, W)."""
    exact, side = image.astype(np.float64), 2 * RADIUS + 1
    mean = ndimage.uniform_filter(exact, side)
    return np.sqrt(np.maximum(ndimage.uniform_filter(exact**2, side) - mean**2, 0.0))


@numba.njit(cache=True, nogil=True, fastmath=True)
def _read_patch(image, column, row, turns):  # type: ignore[no-untyped-def]
    """Return what the correlation of a patch with others needs.

    Returns:
        Its values (side, side) less their weighted mean, their weights, which sum to 1, their standard deviation, the
        direction of its middle pixel in the other photos (k, 3), and its change to the right and below (k, 2, 3).
    """
    side, radius = 2 * RADIUS + 1, RADIUS
    values, weights = np.empty((side, side), np.float32), np.empty((side, side), np.float32)
    total, mean, square = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for i in range(side):
        for j in range(side):
            value = image[row + i - radius, column + j - radius]
            weight = np.exp(-abs(value - image[row, column]) / _SIMILAR)
            values[i, j], weights[i, j] = value, weight
            total += weight
            mean += weight * value
    mean /= total
    for i in range(side):
        for j in range(side):
            weights[i, j] /= total
            values[i, j] -= mean
            square += weights[i, j] * values[i, j] * values[i, j]
    deviation = np.sqrt(max(square, np.float32(1e-6)))
    middle, beside = np.empty((len(turns), 3), np.float32), np.empty((len(turns), 2, 3), np.float32)
    u, v = np.float32(column + 0.5), np.float32(row + 0.5)
    for k in range(len(turns)):
        for axis in range(3):
            middle[k, axis] = turns[k, axis, 0] * u + turns[k, axis, 1] * v + turns[k, axis, 2]
            beside[k, 0, axis], beside[k, 1, axis] = turns[k, axis, 0], turns[k, axis, 1]
    return values, weights, deviation, middle, beside


@numba.njit(cache=True, nogil=True, fastmath=True)
def _score(values, weights, deviation, middle, beside, steps, images, sizes, w, a, b):  # type: ignore[no-untyped-def]
    """Return the mean of the two best correlations of a patch with other photos; with one photo, its correlation."""
    side = values.shape[0]
    radius, edge = side // 2, np.float32(0.01)
    first, second = np.float32(-1.0), np.float32(-1.0)
    for k in range(len(steps)):
        z = middle[k, 2] + steps[k, 2] * w
        if z <= 1e-9:
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
        u, v = u - np.float32(0.5), v - np.float32(0.5)
        if min(u - across, v - down) < edge:
            continue
        if u + across > sizes[k, 1] - 1 - edge or v + down > sizes[k, 0] - 1 - edge:
            continue
        total, squares, product = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for i in range(side):
            x = u - radius * ux + (i - radius) * uy
            y = v - radius * vx + (i - radius) * vy
            for j in range(side):
                column, row = int(x), int(y)
                p, q = x - column, y - row
                upper = images[k, row, column] + p * (images[k, row, column + 1] - images[k, row, column])
                lower = images[k, row + 1, column] + p * (images[k, row + 1, column + 1] - images[k, row + 1, column])
                seen = upper + q * (lower - upper)
                weighted = weights[i, j] * seen
                total += weighted
                squares += weighted * seen
                product += weighted * values[i, j]
                x += ux
                y += vx
        square = squares - total * total
        if square > 0.25:
            correlation = product / (deviation * np.sqrt(square))
            if correlation > first:
                first, second = correlation, first
            elif correlation > second:
                second = correlation
    return first if len(steps) == 1 else np.float32(0.5) * (first + second)


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True)
def _sweep(image, pixels, textured, turns, steps, images, sizes, inverse, planes, scores):  # type: ignore[no-untyped-def]
    """Try fronto-parallel planes; fills the best planes (n, 3) and scores (n,)."""
    flat = np.float32(0.0)
    for n in numba.prange(len(pixels)):
        if not textured[n]:
            continue
        values, weights, deviation, middle, beside = _read_patch(image, pixels[n, 0], pixels[n, 1], turns)
        for w in inverse:
            score = _score(values, weights, deviation, middle, beside, steps, images, sizes, w, flat, flat)
            if score > scores[n]:
                scores[n], planes[n, 0] = score, w


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True)
def _try_planes(image, pixels, allowed, turns, steps, images, sizes, planes, found, scores):  # type: ignore[no-untyped-def]
    """Try given planes (p, 3) where they are allowed (n, p); fills the best planes (n, 3) and scores (n,)."""
    for n in numba.prange(len(pixels)):
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


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True)
def _spread(  # type: ignore[no-untyped-def]
    image, pixels, textured, turns, steps, images, sizes, planes, scores, columns, stride, inverse, tilt, turn
):
    """Try the planes of nearby pixels and random changes, which become smaller each turn; return planes and scores."""
    new, new_scores = planes.copy(), scores.copy()
    rows = len(pixels) // columns
    least, most = inverse[0], inverse[-1]
    step = np.float32(2.0) * (inverse[1] - inverse[0]) * np.float32(0.5) ** turn
    lean = tilt * np.float32(0.5) ** turn
    for n in numba.prange(len(pixels)):
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


@numba.njit(cache=True, nogil=True)
def _random(seed):  # type: ignore[no-untyped-def]
    """Return the next seed and a number in [-1, 1) (xorshift, Marsaglia 2003)."""
    seed = np.uint32(seed ^ (seed << np.uint32(13)))
    seed = np.uint32(seed ^ (seed >> np.uint32(17)))
    seed = np.uint32(seed ^ (seed << np.uint32(5)))
    return seed, np.float32(seed) / np.float32(2147483648.0) - np.float32(1.0)
