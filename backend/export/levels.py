"""Levels of detail of splats, as fewer and larger splats."""

from __future__ import annotations

import numpy as np

from ..model.splats import Splats, concatenate
from ..shared.splats.levels import BLOCK, GROUP, build_levels

_LARGEST_OPACITY = 0.99


def coarser_splats(splats: Splats, levels: int) -> list[Splats]:
    """Merge splats of the same object that lie together.

    Args:
        splats: the splats. Those that renderers do not draw are left out.
        levels: number of levels, at most LEVELS - 1.

    Returns:
        For each level about a fourth of the splats of the one before, from the first, which has a fourth of `splats`.
        Each object keeps the last few of its splats, fewer than BLOCK, as they are.
    """
    if len(splats) == 0:
        return [splats] * levels
    kinds = 2 * splats.object_ids + splats.unobserved
    order = np.argsort(kinds, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(kinds[order])) + 1)
    return [concatenate(level) for level in zip(*(_coarser(splats.select(group), levels) for group in groups))]


def _coarser(splats: Splats, levels: int) -> list[Splats]:
    """Return the levels of splats of one object."""
    # Levels have float32, which is too coarse far from the origin.
    middle = splats.means.mean(0, dtype=np.float64)
    built = build_levels(splats.means - middle, splats.quats, splats.scales, splats.opacities, splats.sh)
    whole = len(built.order) // BLOCK
    left = splats.select(built.order[whole * BLOCK :])
    found = []
    start = 0
    for level in range(1, levels + 1):
        count = whole * BLOCK // GROUP**level
        rows = slice(start, start + count)
        merged = Splats(
            (built.merged.means[rows] + middle).astype(splats.means.dtype),
            built.merged.quats[rows],
            built.merged.scales[rows],
            np.minimum(built.merged.opacities[rows], _LARGEST_OPACITY),
            built.merged.harmonics[rows].astype(np.float32),
            np.full(count, splats.object_ids[0]),
            np.full(count, splats.unobserved[0]),
            splats.blur,
        )
        found.append(concatenate([merged, left]))
        start += count
    return found
