"""The center of a capture's cameras, the distance of its points, and the size of its pixels."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..shared.stopping import Check, proceed

if TYPE_CHECKING:
    from ..capture import Capture

SURROUNDINGS = 10.0
"""Distance of surroundings without points, such as the sky, relative to the radius; parallax is negligible there."""

_VIEWS = 60
"""Largest number of views in which the size of pixels is measured."""

_POINTS = 100_000
"""Largest number of points, spread evenly, at which the size of pixels is measured."""

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


def pixel_size(capture: Capture, check: Check = proceed) -> float:
    """Return the median side of a pixel at the points that it shows, in world units; infinite if none shows any."""
    xyz, sizes = capture.points.xyz[:: -(-len(capture.points.xyz) // _POINTS) or 1], []
    for index in np.unique(np.linspace(0, len(capture.views) - 1, min(len(capture.views), _VIEWS)).astype(int)):
        check()
        view = capture.views[index]
        local = view.to_camera(xyz)
        sizes.append(local[view.pixels_of(local)[0], 2] / view.K[0, 0])
    together = np.concatenate(sizes) if sizes else np.zeros(0)
    return float(np.median(together)) if len(together) else np.inf
