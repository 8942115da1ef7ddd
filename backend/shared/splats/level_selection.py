"""Which levels of detail a view needs: as few splats as keep the error in the image small."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .levels import BLOCK, GROUP, LEVELS, Levels
from .picking import View, may_reach

_BINS_PER_OCTAVE, _OCTAVES = 64, 24
"""Accuracy and range of the search for the error that keeps to the budget."""


class PlacedLevels(NamedTuple):
    """Splats with levels of detail in the world.

    levels: the levels. matrix (4, 4): affine map from the splats' coordinates to the world's. full (B,) bool: the
    blocks that are drawn with all their splats; None: none.
    """

    levels: Levels
    matrix: NDArray
    full: NDArray | None = None


def select(placed: Sequence[PlacedLevels], view: View, pixels: float, budget: int) -> list[NDArray[np.int64]]:
    """Choose for each block in view the coarsest level whose error in the image is small enough.

    The error of a block in the image is that of its level at the depth of its nearest point.

    Args:
        placed: the splats.
        view: the camera or viewport.
        pixels: the largest error in pixels.
        budget: the largest number of splats; if there are more, the error is as large as necessary.

    Returns:
        For each of `placed` the places (n,) of the chosen splats, ascending.
    """
    inside, errors = zip(*(_in_view(*each, view) for each in placed))
    counts = [each.levels.counts[blocks] for each, blocks in zip(placed, inside)]
    largest = _largest_error(np.concatenate(errors), np.concatenate(counts), pixels, budget)
    chosen = []
    for each, blocks, error in zip(placed, inside, errors):
        level = (error <= np.float32(largest)).sum(1) - 1
        chosen.append(_ranges(each.levels.firsts[blocks, level], each.levels.counts[blocks, level]))
    return chosen


def marks_of_places(levels: Levels, marks: NDArray) -> tuple[NDArray, NDArray[np.bool_]]:
    """Return the marks of all places, if each splat has one, such as whether it is selected.

    A merged splat has the mark of the splats of its block. Where these differ, only level 0 shows the marks.

    Args:
        levels: levels of N splats.
        marks: (N,) numbers.

    Returns:
        The marks (n + M,) of the places, and (B,) bool, the blocks whose splats have different marks.
    """
    own = marks[levels.order]
    starts = np.arange(0, len(own), BLOCK)
    least = np.minimum.reduceat(own, starts)
    merged = [np.repeat(least[: len(own) // BLOCK], BLOCK // GROUP**level) for level in range(1, LEVELS)]
    return np.concatenate([own, *merged]), least != np.maximum.reduceat(own, starts)


def _in_view(levels: Levels, matrix: NDArray, full: NDArray | None, view: View) -> tuple[NDArray, NDArray]:
    """Return the blocks (n,) that may reach into the image, and the errors of their levels in pixels (n, LEVELS)."""
    to_camera = np.asarray(view.viewmat, np.float64) @ matrix
    stretch = float(np.linalg.norm(to_camera[:3, :3], 2))
    centers = levels.centers @ to_camera[:3, :3].T + to_camera[:3, 3]
    radii = stretch * levels.radii
    image = (0.0, 0.0, float(view.width), float(view.height))
    blocks = np.flatnonzero(may_reach(view, image, centers, radii, stretch * levels.extents))
    scales = np.full(len(blocks), max(abs(view.fx), abs(view.fy)) * stretch)
    if not view.orthographic:
        scales /= np.maximum(centers[blocks, 2] - radii[blocks], view.near)
    # Objects may have a scale of 0, and the last block may not have all levels.
    with np.errstate(invalid="ignore"):
        errors = np.nan_to_num(levels.errors[blocks] * scales[:, None].astype(np.float32), nan=np.inf, posinf=np.inf)
    if full is not None:
        errors[full[blocks], 1:] = np.inf
    return blocks, errors


def _largest_error(errors: NDArray, counts: NDArray, pixels: float, budget: int) -> float:
    """Return `pixels`, or about the least error at which no more than `budget` splats are drawn, if there is one."""
    over = int(counts[:, 0].sum()) - budget
    if over <= 0:
        return pixels
    saved = (counts[:, :-1] - counts[:, 1:]).reshape(-1)
    # A histogram over the logarithm of the errors, whose first bin has those up to `pixels`.
    with np.errstate(divide="ignore"):
        steps = _BINS_PER_OCTAVE * np.log2(errors[:, 1:].reshape(-1) / np.float32(pixels))
    bins = np.ceil(np.clip(steps, 0, _BINS_PER_OCTAVE * _OCTAVES)).astype(np.int64)
    possible = np.cumsum(np.bincount(bins, saved, _BINS_PER_OCTAVE * _OCTAVES))
    enough = int(np.searchsorted(possible[: _BINS_PER_OCTAVE * _OCTAVES], over))
    return pixels * 2.0 ** (enough / _BINS_PER_OCTAVE)


def _ranges(firsts: NDArray, counts: NDArray) -> NDArray[np.int64]:
    """Return first, first + 1, ..., first + count - 1 for each range of at least one number, in ascending order."""
    order = np.argsort(firsts)
    firsts, counts = firsts[order], counts[order]
    steps = np.ones(int(counts.sum()), np.int64)
    if len(steps):
        steps[0] = firsts[0]
        steps[np.cumsum(counts[:-1])] = firsts[1:] - firsts[:-1] - counts[:-1] + 1
    return np.cumsum(steps, out=steps)
