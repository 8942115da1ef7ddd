"""Floaters: splats of no object around a removed one, which are removed with it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from ..shared.splats.convex_hull import points_inside, reliable_centers


def inside_hull(points: NDArray, means: NDArray, opacities: NDArray) -> NDArray[np.bool_]:
    """Find points inside the convex hull of an object's splats, without its outliers.

    Args:
        points: (n, 3).
        means: (m, 3) centers of the object's splats.
        opacities: (m,) of the object's splats.

    Returns:
        (n,) bool; all False if the splats are coplanar or fewer than four.
    """
    means = reliable_centers(means, opacities)
    if len(means) < 4 or len(points) == 0:
        return np.zeros(len(points), bool)
    middle = np.median(means, axis=0)
    try:
        # Relative to the middle, since far from the origin the hull of a small object would be lost in rounding.
        corners = means - middle
        planes = np.unique(ConvexHull(corners).equations, axis=0)
    except (QhullError, ValueError):
        return np.zeros(len(points), bool)
    return points_inside(points - middle, corners, planes)
