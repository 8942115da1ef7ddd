"""What floats around an object without belonging to one, and is to go with it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from ..hull import body, inside


def inside_hull(points: NDArray, means: NDArray, opacities: NDArray) -> NDArray[np.bool_]:
    """Which of points (n, 3) lie inside the convex hull of an object's splats, strays among them aside: (n,).

    means (m, 3) and opacities (m,) are those of the splats. Fewer than four of them, or flat ones, have no inside.
    """
    means = body(means, opacities)
    if len(means) < 4 or len(points) == 0:
        return np.zeros(len(points), bool)
    middle = np.median(means, axis=0)
    try:
        # Relative to the middle: far from the origin, the hull of something small would be lost in rounding.
        planes = np.unique(ConvexHull(means - middle).equations, axis=0)
    except (QhullError, ValueError):
        return np.zeros(len(points), bool)
    return inside(points - middle, planes)
