"""Levels of detail: splats in blocks of neighbors, and for each block coarser versions of merged splats.

Four splats that lie together become one Gaussian with the weighted mean and covariance of the four, as in hierarchies
of 3D Gaussians (Kerbl et al. 2024), then four of these, and so on. The weight of a splat is its opacity times its mean
projected area.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .blending import ALPHA_MIN, MIN_QUAT_NORM2
from .picking import rotations

GROUP = 4
"""Splats that are merged into one of the next level."""

LEVELS = 5
"""Number of levels: all splats, and those with a GROUP-th of the splats of the level before."""

BLOCK = GROUP ** (LEVELS - 1)
"""Splats in a block, which the coarsest level draws as one."""

_BLOCKS_AT_ONCE = 64

_GRID_BITS = 21


class Merged(NamedTuple):
    """Merged splats, those of finer levels first.

    means (M, 3), quats (M, 4) wxyz, scales (M, 3): float32; harmonics (M, K, 3) float16. opacities (M,) float32 may
    exceed 1: where many splats overlap, the merged one is opaque beyond its center, as they are, since renderers limit
    the alpha of each pixel.
    """

    means: NDArray
    quats: NDArray
    scales: NDArray
    opacities: NDArray
    harmonics: NDArray


class Levels(NamedTuple):
    """Levels of detail of N splats.

    Each splat has a place: the first n <= N places are those of the splats that renderers draw, block by block, and the
    others are those of the merged splats, level by level.

    Attributes:
        order: (n,) int32, the indices of the splats at the first n places.
        merged: the splats at the places from n.
        means: (n + M, 3) float32, the centers at all places.
        firsts, counts: (B, LEVELS) int64, the first place of each block at each level, and the number of places. The
            last block may have fewer than BLOCK splats; then it has level 0 alone.
        centers, radii, extents: (B, 3), (B,), (B,), spheres around the centers of the splats of each block, and the
            largest distance from its center at which one of them is visible.
        errors: (B, LEVELS) float32, weighted root mean square of the distances by which merging moves the splats of a
            block; infinite where there is no level.
    """

    order: NDArray
    merged: Merged
    means: NDArray
    firsts: NDArray
    counts: NDArray
    centers: NDArray
    radii: NDArray
    extents: NDArray
    errors: NDArray


class _Moments(NamedTuple):
    """Splats by their moments: weights (n,), means (n, 3), covariances (n, 3, 3), harmonics (n, K, 3)."""

    weights: NDArray
    means: NDArray
    covariances: NDArray
    harmonics: NDArray


class Stopped(Exception):
    """The levels are no longer needed."""


def build_levels(
    means: NDArray,
    quats: NDArray,
    scales: NDArray,
    opacities: NDArray,
    harmonics: NDArray,
    stop: Callable[[], bool] = lambda: False,
) -> Levels:
    """Build levels of detail.

    Args:
        means: centers (N, 3).
        quats: rotations (N, 4) wxyz of any length.
        scales: standard deviations (N, 3), linear.
        opacities: (N,) in 0 .. 1.
        harmonics: spherical harmonics (N, K, 3).
        stop: asked often.

    Returns:
        The levels.

    Raises:
        Stopped: `stop` returned True.
    """
    order = _along_curve(means, np.flatnonzero(_is_drawn(means, quats, scales, opacities)))
    whole = len(order) // BLOCK
    blocks = -(-len(order) // BLOCK)
    sizes = BLOCK // GROUP ** np.arange(LEVELS)
    starts = np.array([0, *(len(order) + np.cumsum([0, *(whole * sizes[1:])]))])
    rows = int(starts[-1]) - len(order)
    merged = Merged(
        np.empty((rows, 3), np.float32),
        np.empty((rows, 4), np.float32),
        np.empty((rows, 3), np.float32),
        np.empty(rows, np.float32),
        np.empty((rows, *harmonics.shape[1:]), np.float16),
    )
    errors = np.full((blocks, LEVELS), np.inf, np.float32)
    errors[:, 0] = 0.0
    start = 0
    while start < whole:
        if stop():
            raise Stopped
        # A power of two, which can be halved.
        chunk = slice(start, start + (1 << (min(_BLOCKS_AT_ONCE, whole - start).bit_length() - 1)))
        places = slice(chunk.start * BLOCK, chunk.stop * BLOCK)
        own = order[places] = _split(means, order[places])
        splats = _moments(*(values.take(own, axis=0) for values in (means, quats, scales, opacities, harmonics)))
        moved2 = np.zeros(chunk.stop - start)
        for level in range(1, LEVELS):
            splats, away2 = _merge(splats)
            weights = splats.weights.reshape(len(moved2), -1)
            moved2 += (weights * away2.reshape(weights.shape)).sum(1) / weights.sum(1)
            errors[chunk, level] = np.sqrt(moved2)
            _write(merged, int(starts[level]) - len(order) + start * int(sizes[level]), splats)
        start = chunk.stop
    firsts, counts = starts[:LEVELS] + np.arange(blocks)[:, None] * sizes, np.tile(sizes, (blocks, 1))
    firsts[whole:], counts[whole:] = whole * BLOCK, len(order) - whole * BLOCK
    return Levels(
        order,
        merged,
        np.concatenate([means.take(order, axis=0), merged.means]),
        firsts,
        counts,
        *_bounds(means, scales, opacities, order),
        errors,
    )


def _is_drawn(means: NDArray, quats: NDArray, scales: NDArray, opacities: NDArray) -> NDArray[np.bool_]:
    """Return which splats renderers draw, (N,)."""
    norms2 = np.einsum("ij,ij->i", quats, quats)
    drawn = (opacities > ALPHA_MIN) & np.isfinite(opacities) & (norms2 > MIN_QUAT_NORM2) & np.isfinite(norms2)
    return drawn & np.isfinite(means).all(1) & np.isfinite(scales).all(1)


def _along_curve(means: NDArray, which: NDArray) -> NDArray[np.int32]:
    """Order the splats `which` along a Morton curve."""
    if len(which) == 0:
        return which.astype(np.int32)
    keys = np.zeros(len(which), np.int64)
    low, high = means[which].min(0), means[which].max(0)
    side = max(float((high - low).max()), 1e-30)
    for axis in range(3):
        steps = ((means[which, axis].astype(np.float64) - low[axis]) * ((2**_GRID_BITS - 1) / side)).astype(np.int64)
        # Two zero bits before each bit.
        for shift, mask in (
            (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249),
        ):  # fmt: skip
            steps = (steps | (steps << shift)) & mask
        keys |= steps << axis
    return which[np.argsort(keys)].astype(np.int32)


def _split(means: NDArray, order: NDArray) -> NDArray:
    """Reorder splats so that each half, and each half of a half down to GROUP, lies together.

    Splats are halved along the longest side of their bounding box.
    """
    size = len(order)
    order = order.reshape(1, size)
    points = np.ascontiguousarray(np.moveaxis(means[order], 2, 0))
    while size > GROUP:
        axis = np.argmax(points.max(2) - points.min(2), axis=0)
        halves = np.argpartition(points[axis, np.arange(len(axis))], size // 2, axis=1)
        size //= 2
        order = np.take_along_axis(order, halves, 1).reshape(-1, size)
        points = np.take_along_axis(points, halves[None], 2).reshape(3, -1, size)
    return order.reshape(-1)


def _bounds(means: NDArray, scales: NDArray, opacities: NDArray, order: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return the centers (B, 3), radii (B,) and extents (B,) of blocks."""
    starts = np.arange(0, len(order), BLOCK)
    inside = means.take(order, axis=0).astype(np.float64)
    centers = 0.5 * (np.minimum.reduceat(inside, starts) + np.maximum.reduceat(inside, starts))
    inside -= np.repeat(centers, np.diff([*starts, len(order)]), axis=0)
    reach = np.sqrt(2.0 * np.log(opacities[order].astype(np.float64) / ALPHA_MIN)) * np.abs(
        scales.take(order, axis=0)
    ).max(1)
    radii2 = np.maximum.reduceat(np.einsum("ij,ij->i", inside, inside), starts)
    return centers, np.sqrt(radii2), np.maximum.reduceat(reach, starts)


def _moments(means: NDArray, quats: NDArray, scales: NDArray, opacities: NDArray, harmonics: NDArray) -> _Moments:
    quats = quats.astype(np.float64)
    axes = rotations(quats / np.linalg.norm(quats, axis=1, keepdims=True)) * scales[:, None, :]
    weights = np.maximum(opacities * _area(scales), _SMALLEST_AREA)
    return _Moments(weights, means.astype(np.float64), axes @ np.swapaxes(axes, 1, 2), harmonics)


_SMALLEST_AREA = 1e-30


def _area(scales: NDArray) -> NDArray[np.float64]:
    """Return the mean projected area of ellipsoids with these half axes (n, 3), up to a constant factor."""
    x, y, z = scales.T.astype(np.float64)
    return np.sqrt((x * y) ** 2 + (y * z) ** 2 + (z * x) ** 2)


def _merge(splats: _Moments) -> tuple[_Moments, NDArray[np.float64]]:
    """Merge groups of GROUP splats; also return the mean squared distance (m,) from their centers to the new one."""
    weights = splats.weights.reshape(-1, GROUP)
    total = weights.sum(1)
    parts = weights / total[:, None]

    def mean(values: NDArray) -> NDArray:
        shape = values.shape[1:]
        grouped = values.reshape(-1, GROUP, int(np.prod(shape)))
        return sum(parts[:, k, None] * grouped[:, k] for k in range(GROUP)).reshape(-1, *shape)

    center = mean(splats.means)
    away = splats.means - np.repeat(center, GROUP, axis=0)
    spread = mean(away[:, :, None] * away[:, None, :])
    merged = _Moments(total, center, mean(splats.covariances) + spread, mean(splats.harmonics))
    return merged, np.trace(spread, axis1=1, axis2=2)


def _write(merged: Merged, start: int, splats: _Moments) -> None:
    """Store splats in the rows of `merged` from `start`."""
    rows = slice(start, start + len(splats.means))
    values, axes = np.linalg.eigh(splats.covariances)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    scales = np.sqrt(np.maximum(values, 0.0))
    merged.means[rows], merged.quats[rows], merged.scales[rows] = splats.means, _quats(axes), scales
    merged.opacities[rows] = splats.weights / np.maximum(_area(scales), _SMALLEST_AREA)
    merged.harmonics[rows] = splats.harmonics


def _quats(matrices: NDArray) -> NDArray[np.float64]:
    """Convert rotation matrices (n, 3, 3) to unit quaternions (n, 4) wxyz."""
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(matrices, 0, 2)
    # Each row is the quaternion times one of its components; that of the largest component is the most accurate.
    rows = np.array(
        [
            [1 + a + e + i, h - f, c - g, d - b],
            [h - f, 1 + a - e - i, b + d, c + g],
            [c - g, b + d, 1 - a + e - i, f + h],
            [d - b, c + g, f + h, 1 - a - e + i],
        ]
    )
    best = np.argmax(np.einsum("kkn->kn", rows), axis=0)
    found = rows[best, :, np.arange(len(matrices))]
    return found / np.linalg.norm(found, axis=1, keepdims=True)
