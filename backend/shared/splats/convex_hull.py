"""Test of which points are inside an object: in the convex hull of its reliable splats."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MIN_OPACITY = 0.05
"""Splats below this opacity are ignored in an object's extent."""
MAX_DISTANCE_RATIO = 3.0
"""Splats farther from the object's median center than this times the third quartile of the distances are ignored as
mislabeled."""


def reliable_centers(means: NDArray, opacities: NDArray) -> NDArray[np.float64]:
    """Select the splat centers that define an object's extent.

    Args:
        means: the object's splat centers (n, 3).
        opacities: their opacities (n,) in 0 .. 1.

    Returns:
        The centers (m, 3) float64 without faint and stray splats.
    """
    means = means[opacities > MIN_OPACITY].astype(np.float64)
    if len(means) == 0:
        return means
    distances = np.linalg.norm(means - np.median(means, axis=0), axis=1)
    return means[distances <= MAX_DISTANCE_RATIO * np.percentile(distances, 75)]


def points_inside(points: NDArray, planes: NDArray) -> NDArray[np.bool_]:
    """Test which points are inside a convex hull.

    Args:
        points: (n, 3).
        planes: the hull's faces (p, 4): outward normal and offset, such that normal . x + offset <= 0 inside.

    Returns:
        (n,) bool.
    """
    found = np.ones(len(points), bool)
    for plane in planes:
        left = np.flatnonzero(found)
        found[left] = points[left] @ plane[:3] + plane[3] <= 0.0
    return found
