"""Transforms of objects from user input, and the center and luma of an object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..model.splats import Splats
from ..shared.color.recolor import average_luma
from ..shared.reconstruction.objects import Matrix
from ..shared.splats.spherical_harmonics import C0


@dataclass(frozen=True)
class Placement:
    """A transform about the object's own center: a translation x, y, z in the capture's units, rotations rx, ry, rz in
    degrees about the axes x, y and z in this order, and a scale."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    rx: float = 0.0
    ry: float = 0.0
    rz: float = 0.0
    scale: float = 1.0

    def matrix(self, middle: NDArray, upright: NDArray) -> Matrix:
        """Compute the transform of an object in the capture's coordinates.

        Args:
            middle: (3,) center of the object.
            upright: (3, 3) rotation from the capture's coordinates to those of the axes x, y and z.

        Returns:
            The affine map (4, 4).
        """
        turn = Rotation.from_euler("xyz", (self.rx, self.ry, self.rz), degrees=True).as_matrix()
        linear = self.scale * upright.T @ turn @ upright
        shift = middle + upright.T @ (self.x, self.y, self.z) - linear @ middle
        first, second, third = (tuple(row) for row in np.column_stack([linear, shift]).tolist())
        return first, second, third, (0.0, 0.0, 0.0, 1.0)


def middle_of(splats: Splats) -> NDArray[np.float64]:
    """Return the center (3,) of an object, the median of its splats, which outliers do not move."""
    return np.median(splats.means.astype(np.float64), axis=0)


def luma_of(splats: Splats) -> float:
    """Return the luma of an object's average color, 0 .. 1; recoloring keeps the shading relative to it."""
    return average_luma(0.5 + C0 * splats.sh[:, 0], splats.opacities)
