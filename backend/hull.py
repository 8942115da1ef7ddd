"""Which points lie inside an object, by the planes of its convex hull, which the caller brings. Standard library and
NumPy only, so that Blender's own Python can import it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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


def inside(points: NDArray, planes: NDArray) -> NDArray[np.bool_]:
    """Which of points (n, 3) lie behind all planes (p, 4), a normal to the outside and an offset each: (n,)."""
    found = np.ones(len(points), bool)
    for plane in planes:
        left = np.flatnonzero(found)
        found[left] = points[left] @ plane[:3] + plane[3] <= 0.0
    return found
