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


def points_inside(points: NDArray, corners: NDArray, planes: NDArray) -> NDArray[np.bool_]:
    """Test which points are inside a convex hull.

    Args:
        points: (n, 3).
        corners: the points (m, 3) that span the hull, m > 0.
        planes: the hull's faces (p, 4): outward normal and offset, such that normal . x + offset <= 0 inside.

    Returns:
        (n,) bool.
    """
    # Most points of a scene are outside of the box around a hull, which is tested much faster than its faces.
    low, high = corners.min(axis=0), corners.max(axis=0)
    left = np.arange(len(points))
    for axis in range(3):
        along = points[left, axis]
        left = left[(along >= low[axis]) & (along <= high[axis])]
    for plane in planes:
        left = left[points[left] @ plane[:3] + plane[3] <= 0.0]
    found = np.zeros(len(points), bool)
    found[left] = True
    return found
