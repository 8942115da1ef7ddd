"""The background of a model as splats, for programs that draw splats on black."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..model.splats import Splats
from ..shared.splats.spherical_harmonics import C0

COUNT = 1000
"""Splats of the sphere; neighbors are 0.11 radii apart."""

RADII = 8.0
"""Radius of the sphere, in distances of the farthest splat from the center; cameras are nearer."""

_SIGMAS = 0.8
"""Standard deviation of a splat in mean distances of neighbors; splats overlap to an opaque sphere."""

_OPACITY = 0.995


def background_sphere(splats: Splats, color: Sequence[float]) -> Splats:
    """Return splats of one color on a sphere around a scene.

    Args:
        splats: The scene.
        color: Red, green and blue in display space, 0 .. 1.

    Returns:
        COUNT isotropic splats of object 0, with the degree of the scene's spherical harmonics.
    """
    center = np.median(splats.means, axis=0)
    radius = RADII * max(float(np.linalg.norm(splats.means - center, axis=1).max()), float(splats.scales.max()))
    # The spiral of golden angles covers a sphere evenly.
    turn = np.arange(COUNT) * np.pi * (3 - np.sqrt(5))
    z = 1 - (2 * np.arange(COUNT) + 1) / COUNT
    flat = np.sqrt(1 - z * z)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], 1)
    spacing = radius * np.sqrt(4 * np.pi / COUNT)
    sh = np.zeros((COUNT, (splats.degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (np.asarray(color) - 0.5) / C0
    return Splats(
        means=center + radius * directions,
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (COUNT, 1)),
        scales=np.full((COUNT, 3), _SIGMAS * spacing),
        opacities=np.full(COUNT, _OPACITY, np.float32),
        sh=sh,
        object_ids=np.zeros(COUNT, np.int64),
    )
