"""Where an object is moved to, as an affine map of the capture's coordinates, and how bright it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..model.splats import Splats
from ..objects import Matrix
from ..recolour import average_luma
from ..spherical_harmonics import C0


@dataclass(frozen=True)
class Placement:
    """A shift in the capture's units, turns in degrees about the axes x, y and z, one after the other, and a scale;
    turned and scaled about the object's own middle."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    rx: float = 0.0
    ry: float = 0.0
    rz: float = 0.0
    scale: float = 1.0

    def matrix(self, middle: NDArray, upright: NDArray) -> Matrix:
        """The map of an object with this middle (3,). upright (3, 3): the rotation of the capture's coordinates into
        those that the axes belong to."""
        turn = Rotation.from_euler("xyz", (self.rx, self.ry, self.rz), degrees=True).as_matrix()
        linear = self.scale * upright.T @ turn @ upright
        shift = middle + upright.T @ (self.x, self.y, self.z) - linear @ middle
        first, second, third = (tuple(row) for row in np.column_stack([linear, shift]).tolist())
        return first, second, third, (0.0, 0.0, 0.0, 1.0)


def middle_of(splats: Splats) -> NDArray[np.float64]:
    """(3,) the middle of an object's splats, whatever strays from it."""
    return np.median(splats.means.astype(np.float64), axis=0)


def luma_of(splats: Splats) -> float:
    """The luma of the average colour of an object's splats, 0 .. 1, which recolouring keeps its shading by."""
    return average_luma(0.5 + C0 * splats.sh[:, 0], splats.opacities)
