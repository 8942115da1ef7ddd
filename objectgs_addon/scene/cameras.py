# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender cameras that exactly match the pinhole cameras in cameras.json."""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from ...backend.shared.reconstruction.cameras import Cameras, CameraView
from .kinds import CAMERA, KIND, POINTS, capture_of, kind_of, mark, parent_of

SENSOR_WIDTH = 36.0
LARGEST_ASPECT_ERROR = 0.01
_NEAREST, _FARTHEST = 1 / 200, 10.0
"""Least clip distances, relative to the size of the scene."""
DISPLAY_SIZE = 0.25
"""Display size of a camera relative to the median distance between nearest cameras."""


def show_cameras(capture: bpy.types.Collection, parent: bpy.types.Object, cameras: Cameras) -> list[str]:
    """Create or update the cameras in the collection `capture` as children of `parent`, and return warnings.

    Existing cameras are matched by image name; those no longer in `cameras` are removed.
    """
    there: dict[str, bpy.types.Object] = {}
    for obj in capture.objects:
        if kind_of(obj) == CAMERA:
            # Later ones are copies by the user.
            there.setdefault(obj["objectgs_image"], obj)
    poses = [_pose(view, cameras.origin) for view in cameras.views]
    display = DISPLAY_SIZE * _spacing(np.array([pose[:3, 3] for pose in poses]))
    photos = {
        _file_of(image): image
        for image in reversed(list(bpy.data.images))
        if image.library is None and image.source == "FILE"
    }
    for view, pose in zip(cameras.views, poses):
        obj = there.pop(view.name, None)
        if obj is None or obj.data is None:
            obj = bpy.data.objects.new(view.name, bpy.data.cameras.new(view.name))
            mark(obj, CAMERA)
            obj["objectgs_image"] = view.name
            obj.data.display_size = display
            obj.rotation_mode = "QUATERNION"
            obj.parent = parent
            capture.objects.link(obj)
        _place(obj, pose)
        _set_lens(obj.data, view)
        _set_background(obj.data, view, photos)
        obj["held_out"] = view.held_out
        obj["width"], obj["height"] = view.width, view.height
        obj["pixel_aspect"] = view.aspect
    for obj in there.values():
        data = obj.data
        bpy.data.objects.remove(obj)
        if data is not None and data.users == 0:
            bpy.data.cameras.remove(data)
    return _warnings(cameras.views)


def widen_clipping(
    root: bpy.types.Collection, views: Iterable[bpy.types.Camera | bpy.types.SpaceView3D] | None = None
) -> None:
    """Let cameras or viewports see from 1/200 of the size of a reconstruction's capture to ten times that.

    By default, they are all cameras of the capture. Clip distances that are wider are kept.
    """
    capture, parent = capture_of(root), parent_of(root)
    if capture is None or parent is None:
        return
    places = [np.zeros((0, 3))]
    for part in capture.objects:
        matrix = np.array(part.matrix_basis)
        corners = np.array(part.bound_box) if kind_of(part) == POINTS else np.zeros((1, 3))
        places.append(corners @ matrix[:3, :3].T + matrix[:3, 3])
    every = np.concatenate(places)
    if not len(every):
        return
    reach = float(np.linalg.norm(np.ptp(every, axis=0)) * max(map(abs, parent.matrix_world.to_scale())))
    if views is None:
        cameras = (part.data for part in capture.objects if kind_of(part) == CAMERA)
        views = [camera for camera in cameras if camera is not None and camera.library is None]
    for view in views:
        view.clip_start = min(view.clip_start, reach * _NEAREST)
        view.clip_end = max(view.clip_end, reach * _FARTHEST)


def use_camera(scene: bpy.types.Scene, camera: bpy.types.Object) -> None:
    """Make `camera` the scene's camera; for a capture camera, also set the render size and pixel aspect."""
    scene.camera = camera
    if kind_of(camera) != CAMERA:
        return
    use_size(scene, camera)


def use_size(scene: bpy.types.Scene, camera: bpy.types.Object) -> None:
    """Set the render size and pixel aspect to those of a capture camera's photo."""
    for name, value in _size_of(camera).items():
        setattr(scene.render, name, value)


def has_size(scene: bpy.types.Scene, camera: bpy.types.Object) -> bool:
    """Return whether the scene has the render size and pixel aspect of a capture camera's photo."""
    return all(np.isclose(getattr(scene.render, name), value) for name, value in _size_of(camera).items())


def _size_of(camera: bpy.types.Object) -> dict[str, float]:
    """Return the render settings with which a capture camera's render has the size of its photo."""
    aspect = float(camera["pixel_aspect"])
    return {
        "resolution_x": int(camera["width"]), "resolution_y": int(camera["height"]), "resolution_percentage": 100,
        "pixel_aspect_x": max(aspect, 1.0), "pixel_aspect_y": max(1.0 / aspect, 1.0),
    }  # fmt: skip


def _pose(view: CameraView, origin: np.ndarray) -> np.ndarray:
    """Return the (4, 4) map from Blender camera space (x right, y up, looking along -z) to reconstruction space."""
    pose = np.linalg.inv(view.viewmat)
    pose[:3, 3] -= origin
    pose[:3, 1:3] *= -1.0
    return pose


def _place(obj: bpy.types.Object, pose: np.ndarray) -> None:
    location, rotation, _scale = Matrix(pose.tolist()).decompose()
    obj.location = location
    if obj.rotation_mode != "QUATERNION":
        obj.rotation_mode = "QUATERNION"
    obj.rotation_quaternion = rotation


def _set_lens(camera: bpy.types.Camera, view: CameraView) -> None:
    """Set the lens from K; Blender's shifts are relative to the image width, its focal length is in sensor units."""
    camera.type = "PERSP"
    camera.sensor_fit = "HORIZONTAL"
    camera.sensor_width = SENSOR_WIDTH
    camera.lens_unit = "MILLIMETERS"
    camera.lens = view.K[0, 0] * SENSOR_WIDTH / view.width
    camera.shift_x = (view.width / 2.0 - view.K[0, 2]) / view.width
    camera.shift_y = (view.K[1, 2] - view.height / 2.0) / view.aspect / view.width


def _set_background(camera: bpy.types.Camera, view: CameraView, photos: dict[Path, bpy.types.Image]) -> None:
    """Set the photo as background image; Blender reads the file when it first draws it.

    photos: the images of the .blend by their files, to which a new one is added.
    """
    ours = next(
        (entry for entry in camera.background_images if entry.image is not None and entry.image.get(KIND) == "photo"),
        None,
    )
    if not view.image.is_file():
        if ours is not None:
            camera.background_images.remove(ours)
        return
    if ours is None:
        ours = camera.background_images.new()
        ours.alpha = 1.0
        ours.frame_method = "FIT"
        camera.show_background_images = True
    if ours.image is None or _file_of(ours.image) != view.image:
        if view.image not in photos:  # With `check_existing`, Blender would search all images for each.
            photos[view.image] = bpy.data.images.load(str(view.image))
        ours.image = photos[view.image]
        ours.image[KIND] = "photo"


def _file_of(image: bpy.types.Image) -> Path:
    """Return the file of an image, whose path may be relative to the .blend."""
    return Path(os.path.normpath(bpy.path.abspath(image.filepath)))


def _spacing(centers: np.ndarray) -> float:
    """Return the median distance from a camera to its nearest neighbor; 1 for a single camera or position."""
    if len(centers) < 2:
        return 1.0
    some = centers[:: max(1, len(centers) // 500)]
    nearest = np.empty(len(some))
    for index, center in enumerate(some):
        apart = np.linalg.norm(centers - center, axis=1)
        apart = apart[apart > 1e-9 * (1.0 + np.abs(center).max())]
        nearest[index] = apart.min() if len(apart) else np.nan
    found = nearest[np.isfinite(nearest)]
    return float(np.median(found)) if len(found) else 1.0


def _warnings(views: Sequence[CameraView]) -> list[str]:
    warnings = []
    aspects = [view.aspect for view in views]
    if aspects and max(aspects) / min(aspects) - 1.0 > LARGEST_ASPECT_ERROR:
        warnings.append(
            "The capture's cameras have different pixel aspect ratios, but a Blender scene has only one; select a "
            "camera and use Set Up Render before rendering through it."
        )
    skewed = [view.name for view in views if abs(view.K[0, 1]) > 1e-6 * view.K[0, 0]]
    if skewed:
        warnings.append(f"{len(skewed)} cameras have skew (for example {skewed[0]}), which Blender does not support.")
    missing = [view.image for view in views if not view.image.is_file()]
    if missing:
        warnings.append(
            f"{len(missing)} of {len(views)} images are missing (for example {missing[0]}); their cameras have "
            "no background image. Run Import again."
        )
    return warnings
