"""Views by which splats are compared: those of photos, or cameras around splats that come without photos."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from ..capture import Capture
from ..evaluation.images import as_bytes
from ..model.object_model import Normalization
from ..raster import Camera
from ..shared.splats.blending import EPS_2D
from .strokes import Viewpoint

_SIZE = 400
"""Side of the square pictures from cameras around splats, in pixels."""
_OUTSIDE, _INSIDE = 24, 6
"""Number of cameras above the scene, and of places within it from which a camera each looks at the six sides."""
_ANGLE, _WITHIN = np.radians(50.0), 80
"""Field of view of the cameras above the scene, and percentage of the splats nearest to its center that they show."""
_GRID, _CLEARANCE = 6, 0.1
"""Number of places that are tried along each axis, and their least distance from splats relative to the scene."""


class Views(NamedTuple):
    """Views of splats.

    Attributes:
        names: names of the photos; empty if there are none.
        camera: returns the camera of a view by its index, in scene units.
        used: indices of the views by which splats are compared.
        normalization: transform between the capture's world and scene units.
        photo: returns the photo (H, W, 3) uint8 of a view by its index; None if there are none.
        blur: variance of the low-pass filter with which the splats are drawn in other views.
    """

    names: Sequence[str]
    camera: Callable[[int], Camera]
    used: Sequence[int]
    normalization: Normalization
    photo: Callable[[int], np.ndarray] | None
    blur: float = EPS_2D

    def reference(self, index: int) -> str | Viewpoint:
        """Return what a stroke in a view refers to: the name of the photo, or else the camera."""
        if self.names:
            return self.names[index]
        camera = self.camera(index)
        viewmat, (fx, fy, cx, cy) = camera.viewmat.copy(), camera.arrays()[1]
        viewmat[:3, 3] = viewmat[:3, 3] / self.normalization.scale - viewmat[:3, :3] @ self.normalization.center
        rows = tuple(tuple(float(value) for value in row) for row in viewmat)
        return Viewpoint(rows, (float(fx), float(fy), float(cx), float(cy)), camera.width, camera.height)


def views_of_photos(capture: Capture, camera: Callable[[int], Camera], normalization: Normalization) -> Views:
    """Return the views of a capture's photos, of which those of the training are used.

    Args:
        capture: the capture.
        camera: returns the camera of a view by its index, in scene units.
        normalization: transform between the capture's world and scene units.
    """
    return Views(
        [view.name for view in capture.views], camera, capture.train_indices, normalization,
        lambda index: as_bytes(capture.image(index)),
    )  # fmt: skip


def views_around(means: np.ndarray, up: np.ndarray, normalization: Normalization) -> Views:
    """Return cameras that show splats without photos: from above the scene, and from free places within it.

    Args:
        means: (N, 3) centers of the splats, in scene units.
        up: (3,) unit vector.
        normalization: transform between the splats' world and scene units.
    """
    cameras = [*_above(means, up), *_within(means, up)]
    return Views((), cameras.__getitem__, range(len(cameras)), normalization, None)


def _above(means: np.ndarray, up: np.ndarray) -> list[Camera]:
    """Return cameras on the upper half of a sphere, in a spiral, that look at its center."""
    center = np.median(means, axis=0)
    reach = float(np.percentile(np.linalg.norm(means - center, axis=1), _WITHIN)) or 1.0
    heights = (np.arange(_OUTSIDE) + 0.5) / _OUTSIDE
    turns = np.arange(_OUTSIDE) * np.pi * (3 - np.sqrt(5))
    level = np.sqrt(1 - heights**2)
    east, north = _level_axes(up)
    directions = (
        (level * np.cos(turns))[:, None] * east + (level * np.sin(turns))[:, None] * north + heights[:, None] * up
    )
    distance = reach / np.sin(_ANGLE / 2)
    return [_camera(center + distance * direction, -direction, up, _ANGLE) for direction in directions]


def _within(means: np.ndarray, up: np.ndarray) -> list[Camera]:
    """Return cameras at the places that are farthest from splats and from each other; none if it is full."""
    low, high = np.percentile(means, (10, 90), axis=0)
    axes = [np.linspace(*ends, _GRID) for ends in zip(low, high, strict=True)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    free, _ = cKDTree(means).query(places)
    least = _CLEARANCE * float(np.linalg.norm(high - low))
    east, north = _level_axes(up)
    cameras: list[Camera] = []
    for _ in range(_INSIDE):
        best = int(free.argmax())
        if free[best] <= least:
            break
        cameras += [_camera(places[best], sign * axis, up, np.pi / 2) for axis in (east, north, up) for sign in (1, -1)]
        free = np.minimum(free, np.linalg.norm(places - places[best], axis=1))
    return cameras


def _level_axes(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors that are perpendicular to up and to each other."""
    east = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    east /= np.linalg.norm(east)
    return east, np.cross(up, east)


def _camera(center: np.ndarray, forward: np.ndarray, up: np.ndarray, angle: float) -> Camera:
    """Return a camera with a square picture; angle: field of view in radians."""
    right = np.cross(forward, up)
    length = float(np.linalg.norm(right))
    right = right / length if length > 1e-6 else _level_axes(up)[0]
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    focal = _SIZE / 2 / np.tan(angle / 2)
    return Camera(viewmat, np.array([[focal, 0, _SIZE / 2], [0, focal, _SIZE / 2], [0, 0, 1.0]]), _SIZE, _SIZE)
