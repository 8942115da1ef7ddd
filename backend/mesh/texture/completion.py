"""Completion of an image with patches of its known part.

The part to complete begins as a copy of the known place whose surroundings fit best (as in He and Sun 2012). It is then
made of small patches that are alike where they overlap, from coarse to fine (Wexler et al. 2007), which are found by
PatchMatch (Barnes et al. 2009).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt

from ...raster.kernel import kernel

_RADIUS = 3
"""Patches have 2 * _RADIUS + 1 pixels on a side."""

_COARSER, _THINNEST = 2, 2.5
"""Largest number of coarser images, and half the width of the part to complete below which there is none."""

_ROUNDS, _SWEEPS = 3, 2
"""Number of times that an image is made of patches, and of sweeps of the search before each."""

_ALIKE = 0.1
"""Cost of patches relative to that of most of them by which their weight decreases to 1 / e."""

_TRUST = 1.3
"""Factor by which the weight of patches decreases with each pixel from the known part."""

_BAND, _SAMPLES, _LEAST = 6, 250, 0.8
"""Width of the surroundings that a copy must fit to, largest number of pixels by which fits are compared, and smallest
fraction of a copy that is known."""


class _Level(NamedTuple):
    """An image (H, W, C) float64, and where it is known, and to be completed, (H, W) bool."""

    values: np.ndarray
    known: np.ndarray
    wanted: np.ndarray


def complete(values: np.ndarray, known: np.ndarray, wanted: np.ndarray) -> np.ndarray | None:
    """Complete a part of an image.

    Args:
        values: (H, W, C) float64; used only where known. The detail without shading fits best.
        known: (H, W) bool.
        wanted: (H, W) bool, the part to complete, of which nothing is known. The rest is neither used nor completed.

    Returns:
        The image (H, W, C), valid where known or wanted; None if too little is known.
    """
    shift = _best_shift(values, known, wanted)
    levels = [_Level(values, known, wanted)]
    while len(levels) <= _COARSER and distance_transform_edt(np.pad(levels[-1].wanted, 1)).max() > _THINNEST:
        levels.append(_halved(levels[-1]))
    padded = [_padded(level) for level in levels]
    sources = [binary_erosion(level.known, np.ones(2 * [2 * _RADIUS + 1])) for level in padded]
    nearest: np.ndarray | None = None
    for number in reversed(range(len(levels))):
        if not sources[number].any():
            continue
        level, source = padded[number], sources[number]
        targets = _patches_over(level.wanted)
        found = np.argwhere(source)
        start = found[np.random.default_rng(number).integers(len(found), size=len(targets))]
        if nearest is not None:
            _take(start, _finer(nearest, targets), source)
        elif shift is not None:
            _take(start, targets + np.rint(shift / 2**number).astype(np.int64), source)
        work, nearest = _made_of_patches(level, targets, source, start, number)
    if nearest is None or not sources[0].any():
        return None
    return work[_RADIUS:-_RADIUS, _RADIUS:-_RADIUS]


def _halved(level: _Level) -> _Level:
    """Return an image of half the size; pixels of which half is known are known."""
    height, width = ((side + 1) // 2 for side in level.known.shape)
    grow = [(0, 2 * height - level.known.shape[0]), (0, 2 * width - level.known.shape[1])]
    known, wanted = np.pad(level.known, grow), np.pad(level.wanted, grow)
    sums = np.where(known[..., None], np.pad(level.values, [*grow, (0, 0)]), 0.0)
    count = known.reshape(height, 2, width, 2).sum((1, 3))
    means = sums.reshape(height, 2, width, 2, -1).sum((1, 3)) / np.maximum(count, 1)[..., None]
    return _Level(means, count >= 2, wanted.reshape(height, 2, width, 2).any((1, 3)) & (count < 2))


def _padded(level: _Level) -> _Level:
    """Return an image with a border as wide as a patch reaches; what is not known is like the nearest known pixel."""
    known, wanted = np.pad(level.known, _RADIUS), np.pad(level.wanted, _RADIUS)
    values = np.pad(np.asarray(level.values, np.float64), [(_RADIUS, _RADIUS)] * 2 + [(0, 0)])
    if known.any():
        values = values[tuple(distance_transform_edt(~known, return_distances=False, return_indices=True))]
    return _Level(np.ascontiguousarray(values), known, wanted)


def _patches_over(wanted: np.ndarray) -> np.ndarray:
    """Return the centers (n, 2) of the patches that reach a part of a padded image."""
    reached = np.zeros(wanted.shape, bool)
    binary_dilation(wanted, np.ones(2 * [2 * _RADIUS + 1]), output=reached)
    reached[:_RADIUS] = reached[-_RADIUS:] = reached[:, :_RADIUS] = reached[:, -_RADIUS:] = False
    return np.argwhere(reached)


def _take(start: np.ndarray, proposed: np.ndarray, source: np.ndarray) -> None:
    """Replace places (n, 2) by the proposed ones that are in `source` (H, W), in place."""
    inside = np.all((proposed >= 0) & (proposed < source.shape), axis=1)
    inside[inside] = source[tuple(proposed[inside].T)]
    start[inside] = proposed[inside]


def _finer(nearest: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return what a coarser image proposes for patches (n, 2): the places (H, W, 2) there, or -1, in the finer one."""
    coarser = (targets - _RADIUS) // 2 + _RADIUS
    coarser = np.minimum(coarser, np.array(nearest.shape[:2]) - 1)
    there = nearest[tuple(coarser.T)]
    return np.where(there < 0, -1, 2 * (there - _RADIUS) + (targets - _RADIUS) % 2 + _RADIUS)


def _made_of_patches(
    level: _Level, targets: np.ndarray, source: np.ndarray, start: np.ndarray, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Complete a padded image from the patches around `targets` (n, 2), which begin as those around `start` (n, 2).

    Returns:
        The image, and for each pixel the center of the patch of `source` that fits there, (H, W, 2) int64, or -1.
    """
    work, cost = level.values.copy(), np.zeros(len(targets))
    index = np.full(level.wanted.shape, -1, np.int64)
    index[tuple(targets.T)] = np.arange(len(targets))
    trust = _TRUST ** -distance_transform_edt(level.wanted)
    places, rng = np.ascontiguousarray(start), np.random.default_rng(seed)
    _vote(work, level.wanted, targets, places, cost, trust, 1.0)
    for _ in range(_ROUNDS):
        _search(work, targets, source, places, cost, index, _SWEEPS, rng)
        _vote(work, level.wanted, targets, places, cost, trust, max(_ALIKE * float(np.percentile(cost, 75)), 1e-12))
    nearest = np.full((*level.wanted.shape, 2), -1, np.int64)
    nearest[tuple(targets.T)] = places
    return work, nearest


def _best_shift(values: np.ndarray, known: np.ndarray, wanted: np.ndarray) -> np.ndarray | None:
    """Return the shift (2,) from the wanted part to the known place whose surroundings fit best, if there is one."""
    inside = np.argwhere(wanted)
    band = np.argwhere(binary_dilation(wanted, iterations=_BAND) & known)
    if not len(band) or not len(inside):
        return None
    inside, band = inside[:: -(-len(inside) // _SAMPLES)], band[:: -(-len(band) // _SAMPLES)]
    height, width = known.shape
    scores = np.full((2 * height - 1, 2 * width - 1), np.inf)
    strength = 2.0 * float((values[known] ** 2).sum(1).mean())
    _score_shifts(np.ascontiguousarray(values, np.float64), known, inside, band, strength, _LEAST, scores)
    at = np.array(np.unravel_index(scores.argmin(), scores.shape))
    return at - [height - 1, width - 1] if np.isfinite(scores.min()) else None


@kernel(parallel=True)
def _score_shifts(values, known, inside, band, strength, least, scores):
    """Write into `scores` how much the band differs from the known pixels that each shift moves it to."""
    height, width, channels = values.shape
    for row in prange(scores.shape[0]):
        for column in range(scores.shape[1]):
            dy, dx = row - height + 1, column - width + 1
            covered = 0
            for n in range(inside.shape[0]):
                y, x = inside[n, 0] + dy, inside[n, 1] + dx
                if 0 <= y < height and 0 <= x < width and known[y, x]:
                    covered += 1
            if covered < least * inside.shape[0]:
                continue
            total = 0.0
            for n in range(band.shape[0]):
                y, x = band[n, 0] + dy, band[n, 1] + dx
                if 0 <= y < height and 0 <= x < width and known[y, x]:
                    for c in range(channels):
                        total += (values[y, x, c] - values[band[n, 0], band[n, 1], c]) ** 2
                else:
                    total += strength
            scores[row, column] = total / band.shape[0] + (1.0 - covered / inside.shape[0]) * strength


@kernel()
def _difference(values, ay, ax, by, bx, least):
    """Return the sum of squared differences of two patches, or a part of it that is at least `least`."""
    total = 0.0
    for i in range(-_RADIUS, _RADIUS + 1):
        for j in range(-_RADIUS, _RADIUS + 1):
            for c in range(values.shape[2]):
                total += (values[ay + i, ax + j, c] - values[by + i, bx + j, c]) ** 2
        if total >= least:
            break
    return total


@kernel()
def _search(values, targets, source, places, cost, index, sweeps, rng):
    """Improve the places (n, 2) in `source` of the patches that are most like those around `targets` (n, 2)."""
    height, width = source.shape
    for n in range(targets.shape[0]):
        cost[n] = _difference(values, targets[n, 0], targets[n, 1], places[n, 0], places[n, 1], np.inf)
    for sweep in range(sweeps):
        back = sweep % 2 == 1
        step = 1 if back else -1
        for k in range(targets.shape[0]):
            n = targets.shape[0] - 1 - k if back else k
            y, x = targets[n, 0], targets[n, 1]
            for axis in range(2):
                beside_y, beside_x = (y + step, x) if axis == 0 else (y, x + step)
                beside = index[beside_y, beside_x]
                if beside < 0:
                    continue
                to_y, to_x = places[beside, 0] + y - beside_y, places[beside, 1] + x - beside_x
                if 0 <= to_y < height and 0 <= to_x < width and source[to_y, to_x]:
                    different = _difference(values, y, x, to_y, to_x, cost[n])
                    if different < cost[n]:
                        cost[n], places[n, 0], places[n, 1] = different, to_y, to_x
            reach = max(height, width)
            while reach >= 1:
                to_y = places[n, 0] - reach + int(rng.random() * (2 * reach + 1))
                to_x = places[n, 1] - reach + int(rng.random() * (2 * reach + 1))
                if 0 <= to_y < height and 0 <= to_x < width and source[to_y, to_x]:
                    different = _difference(values, y, x, to_y, to_x, cost[n])
                    if different < cost[n]:
                        cost[n], places[n, 0], places[n, 1] = different, to_y, to_x
                reach //= 2


@kernel()
def _vote(values, wanted, targets, places, cost, trust, scale):
    """Replace the wanted pixels by the weighted means of the patches that reach them."""
    sums, weights = np.zeros(values.shape), np.zeros(wanted.shape)
    for n in range(targets.shape[0]):
        y, x = targets[n, 0], targets[n, 1]
        weight = np.exp(-cost[n] / scale) * trust[y, x] + 1e-12
        for i in range(-_RADIUS, _RADIUS + 1):
            for j in range(-_RADIUS, _RADIUS + 1):
                if wanted[y + i, x + j]:
                    weights[y + i, x + j] += weight
                    for c in range(values.shape[2]):
                        sums[y + i, x + j, c] += weight * values[places[n, 0] + i, places[n, 1] + j, c]
    for y in range(wanted.shape[0]):
        for x in range(wanted.shape[1]):
            if wanted[y, x] and weights[y, x] > 0.0:
                for c in range(values.shape[2]):
                    values[y, x, c] = sums[y, x, c] / weights[y, x]
