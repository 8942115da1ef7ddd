"""Floaters of an object: its splats far from the rest of it, and small groups of its splats apart from the rest.

The result does not depend on the order, the unit or the origin of the splats, so that both processes find the same.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FAR_RATIO = 5.0
"""Splats farther from the object's median center than this times the third quartile of the distances are far."""
CELLS = 32.0
"""Cells across the object's size, in a grid in which splats in neighboring cells belong together."""
SPACING = 3.0
"""Smallest side of a cell relative to the average distance of the object's splats on its surface."""
SMALLEST_PART = 0.02
"""Smallest fraction of the object's splats in a group that is apart from the rest but part of the object."""
BEYOND, ALMOST_ALL = 5.0, 98.0
"""Splats farther from the median of the capture's points than BEYOND times this percentile of the points' distances
show distant surroundings, such as the sky."""
FEWEST = 32
"""Objects with fewer splats have no floaters, since their extent is uncertain."""

_HALF = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) > (0, 0, 0)]


def far(means: NDArray) -> NDArray[np.bool_]:
    """Find the splats, or points of a cloud, that are far from the middle of all of them.

    Args:
        means: their centers (n, 3).

    Returns:
        (n,) bool.
    """
    if len(means) < FEWEST:
        return np.zeros(len(means), bool)
    distances = _distances(means)
    return distances > FAR_RATIO * np.percentile(distances, 75)


def near_sphere(points: NDArray) -> tuple[NDArray, float]:
    """Return the center (3,) and the radius of the sphere outside of which splats show distant surroundings.

    The radius is infinite if there are too few points to tell.

    Args:
        points: the capture's points (m, 3).
    """
    if len(points) < FEWEST:
        return np.zeros(3), np.inf
    middle = np.median(points, axis=0)
    distances = np.linalg.norm(points.astype(np.float64) - middle, axis=1)
    return middle, BEYOND * float(np.percentile(distances, ALMOST_ALL))


def distant(means: NDArray, center: NDArray, radius: float) -> NDArray[np.bool_]:
    """Find the splats that show distant surroundings.

    Args:
        means: splat centers (n, 3).
        center: center (3,) of the capture's `near_sphere`, in the same coordinates.
        radius: its radius.

    Returns:
        (n,) bool.
    """
    return np.linalg.norm(means.astype(np.float64) - center, axis=1) > radius


def floating(means: NDArray) -> NDArray[np.bool_]:
    """Find the floaters of an object: far splats, and small groups of splats apart from the rest.

    Args:
        means: the object's splat centers (n, 3).

    Returns:
        (n,) bool.
    """
    found = far(means)
    near = np.flatnonzero(~found)
    if len(near) < FEWEST:
        return found
    distances = _distances(means)[near]
    size = 2.0 * float(np.percentile(distances, 75))
    if size <= 0.0:
        return found
    side = size * max(1.0 / CELLS, SPACING / np.sqrt(len(near)))
    groups = _groups(means[near].astype(np.float64) - np.median(means, axis=0), side)
    found[near] = np.bincount(groups)[groups] < SMALLEST_PART * len(near)
    return found


def _distances(means: NDArray) -> NDArray[np.float64]:
    return np.linalg.norm(means.astype(np.float64) - np.median(means, axis=0), axis=1)


def _groups(places: NDArray, side: float) -> NDArray[np.int64]:
    """Number the groups of points (n, 3) whose cells of a grid touch: (n,)."""
    cells = np.floor(places / side).astype(np.int64)
    cells -= cells.min(axis=0) - 1
    across = cells.max(axis=0) + 2
    steps = np.array([across[1] * across[2], across[2], 1])
    keys, cell_of = np.unique(cells @ steps, return_inverse=True)
    pairs = []
    for offset in _HALF:
        at = np.searchsorted(keys, keys + np.array(offset) @ steps)
        at[at == len(keys)] = 0
        first = np.flatnonzero(keys[at] == keys + np.array(offset) @ steps)
        pairs.append(np.stack([first, at[first]]))
    first, second = np.concatenate(pairs, axis=1)
    # Each cell points to one of a smaller number in its group, until all point to the smallest one.
    to = np.arange(len(keys))
    while True:
        low = np.minimum(to[first], to[second])
        before = to.copy()
        np.minimum.at(to, to[first], low)
        np.minimum.at(to, to[second], low)
        to = to[to]
        if np.array_equal(to, before):
            return to[cell_of.reshape(-1)]
