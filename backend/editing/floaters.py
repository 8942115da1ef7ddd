"""What floats around an object without belonging to one, and is to go with it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

FAINT = 0.05
"""Splats of an object below this opacity do not say how far it reaches."""
STRAY = 3.0
"""Nor do those so many times as far from its middle as three quarters of its splats are: they are wrongly labelled."""


def body(means: NDArray, opacities: NDArray) -> NDArray[np.float64]:
    """Those of an object's centres (n, 3), with opacities (n,), that say where it is: (m, 3)."""
    means = means[opacities > FAINT].astype(np.float64)
    if len(means) == 0:
        return means
    distances = np.linalg.norm(means - np.median(means, axis=0), axis=1)
    return means[distances <= STRAY * np.percentile(distances, 75)]


def inside_hull(points: NDArray, means: NDArray, opacities: NDArray) -> NDArray[np.bool_]:
    """Which of points (n, 3) lie inside the convex hull of an object's splats, strays among them aside: (n,).

    means (m, 3) and opacities (m,) are those of the splats. Fewer than four of them, or flat ones, have no inside.
    """
    means = body(means, opacities)
    nothing = np.zeros(len(points), bool)
    if len(means) < 4 or len(points) == 0:
        return nothing
    middle = np.median(means, axis=0)
    try:
        # Relative to the middle: far from the origin, the hull of something small would be lost in rounding.
        faces = np.unique(ConvexHull(means - middle).equations, axis=0)
    except (QhullError, ValueError):
        return nothing
    inside = ~nothing
    for face in faces:
        left = np.flatnonzero(inside)
        inside[left] = (points[left] - middle) @ face[:3] + face[3] <= 0.0
    return inside
