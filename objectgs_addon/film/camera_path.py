# SPDX-License-Identifier: GPL-3.0-or-later
"""A camera that moves along the cameras of a capture."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np
from mathutils import Matrix

from ..scene import matrix_to_world

MOST_KEYS = 12
"""Number of cameras that the path passes through; more would repeat the shaking of a hand."""

_MOST_ORDERED = 500
"""Number of cameras that are put in order, which takes time and memory by its square."""

_LENS = ("sensor_fit", "sensor_width", "sensor_height", "lens", "shift_x", "shift_y", "clip_start", "clip_end")
"""Settings of a camera that another one gets."""

_JUMP = 3.0
"""Mean step from one camera to the next, relative to the distance of nearest cameras, from which on they count as
unordered."""


def path_order(centers: np.ndarray) -> np.ndarray:
    """Return an order in which the cameras at `centers` (n, 3) form a path, as indices (n,).

    Cameras that were taken along a path keep their order; otherwise each is followed by the nearest of the rest.
    """
    count = len(centers)
    if count < 3:
        return np.arange(count)
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    nearest = (apart + np.diag(np.full(count, np.inf))).min(1)
    if np.linalg.norm(np.diff(centers, axis=0), axis=1).mean() <= _JUMP * nearest.mean():
        return np.arange(count)
    order, left = [0], set(range(1, count))
    while left:
        order.append(min(left, key=lambda index: apart[order[-1], index]))
        left.remove(order[-1])
    return np.array(order)


def make_path(scene: bpy.types.Scene, cameras: Sequence[bpy.types.Object], first: int, last: int) -> bpy.types.Object:
    """Create a camera with keyframes along cameras, and make it the scene's.

    Args:
        scene: the scene.
        cameras: at least two cameras, in the order of their names.
        first: frame at the first of them.
        last: frame at the last of them.

    Returns:
        The camera, which has the lens of the first of them.
    """
    cameras = [cameras[index] for index in _spread(len(cameras), _MOST_ORDERED)]
    # Blender does not update the matrices of cameras in a collection that is excluded from the view layer.
    poses = [Matrix(matrix_to_world(camera).tolist()) for camera in cameras]
    order = path_order(np.array([pose.translation for pose in poses]))
    chosen = order[_spread(len(order), MOST_KEYS)]
    moving = new_camera(scene, "Camera Path", cameras[chosen[0]].data)
    before = None
    for frame, index in zip(np.linspace(first, last, len(chosen)), chosen.tolist()):
        location, rotation, _scale = poses[index].decompose()
        if before is not None and before.dot(rotation) < 0:
            rotation.negate()  # The shorter of two rotations.
        before = rotation
        moving.location, moving.rotation_quaternion = location, rotation
        for name in ("location", "rotation_quaternion"):
            moving.keyframe_insert(name, frame=float(frame))
    return moving


def _spread(count: int, most: int) -> np.ndarray:
    """Return at most `most` of the indices 0 .. count - 1, evenly from the first to the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def new_camera(scene: bpy.types.Scene, name: str, like: bpy.types.Camera | None) -> bpy.types.Object:
    """Create a camera in a scene, make it the scene's, and give it the lens of the camera `like`, if there is one."""
    data = bpy.data.cameras.new(name)
    if like is not None:
        for setting in _LENS:
            setattr(data, setting, getattr(like, setting))
    camera = bpy.data.objects.new(name, data)
    camera.rotation_mode = "QUATERNION"
    scene.collection.objects.link(camera)
    scene.camera = camera
    return camera
