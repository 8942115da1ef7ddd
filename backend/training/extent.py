"""The center of a capture's cameras and the distance of its points."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from ..capture import Capture

SURROUNDINGS = 10.0
"""Distance of surroundings without points, such as the sky, relative to the radius; parallax is negligible there."""

_PERCENTILE = 98
"""Percentile of the points' distances that is the radius; few points beyond it are on a surface."""


class Extent(NamedTuple):
    """A sphere: center (3,) float64 and radius, in world units."""

    center: np.ndarray
    radius: float


def extent_of(capture: Capture) -> Extent:
    """Return the sphere around the cameras of a capture that contains almost all of its points."""
    matrices = np.array([view.viewmat for view in capture.views])
    center = -np.einsum("nji,nj->ni", matrices[:, :3, :3], matrices[:, :3, 3]).mean(0)
    distances = np.linalg.norm(capture.points.xyz - center, axis=1)
    return Extent(center, float(np.percentile(distances, _PERCENTILE)) if len(distances) else 1.0)
