# SPDX-License-Identifier: GPL-3.0-or-later
"""Sampling of a scene's camera and a reconstruction's objects over time as a shot in capture coordinates.

A shot contains the splats that Blender would render: those of every object whose collections, pivot and parts are not
hidden in renders or from the camera. The reconstruction's own collection may be hidden, since the compositor combines
film frames with Blender's rendering without the reconstruction. An object not moved in Blender keeps its transform from
objects.json.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import bpy
import numpy as np

from ...backend.shared.errors import InputError
from ...backend.shared.reconstruction.objects import is_singular
from ...backend.shared.reconstruction.shot import Frame, Placed, Sample, Shot
from ..scene.capture import origin_of
from ..scene.kinds import parent_of, require_parent
from ..scene.object_collection import center_of
from .instances import SplatsInstance, evaluated_pivots, instances_of, layer_paths, world_of

TOLERANCE = 2e-6
"""Tolerance, relative to the scene size, up to which an object counts as not moved, since Blender stores float32."""

_TO_OPENCV = np.diag([1.0, -1.0, -1.0])
_UNSUPPORTED = {"ORTHO": "orthographic", "PANO": "panoramic"}


def shot_of(
    scene: bpy.types.Scene,
    view_layer: bpy.types.ViewLayer,
    root: bpy.types.Collection,
    frames: Sequence[int],
    samples: int = 1,
    progress: Callable[[int, int], object] = lambda *_: None,
    camera: bpy.types.Object | None = None,
) -> Shot:
    """Sample the scene's frames as a shot of a reconstruction; the scene's current frame is restored.

    Args:
        scene: scene with the camera, resolution and motion blur.
        view_layer: view layer with the visibility of collections.
        root: the reconstruction's collection.
        frames: frame numbers, ascending.
        samples: sub-frames per frame while the shutter is open; 1 samples the frame itself.
        progress: called with (done, total) after every frame.
        camera: the camera; None: the scene's at each frame, which markers may change.

    Returns:
        The shot.

    Raises:
        InputError: The parent empty or the camera is missing, the camera is not perspective, the frames are empty or
            start below 0, or the reconstruction is scaled to zero.
    """
    require_parent(root)
    if not frames:
        raise InputError("The scene's frame range is empty; set its start and end.")
    if frames[0] < 0:
        raise InputError("The first frame is below 0, but image sequences have no negative numbers; move the shot.")
    with bpy.context.temp_override(scene=scene, view_layer=view_layer):
        # Without it, what is excluded from the window's view layer would stay where it is in all frames.
        bpy.context.evaluated_depsgraph_get()
    instances = instances_of(scene, root, layer_paths(view_layer, root))
    before = scene.frame_current, scene.frame_subframe
    has_markers = any(marker.camera is not None for marker in scene.timeline_markers)
    made, scale, places = [], None, _Places()
    try:
        with evaluated_pivots(view_layer, instances):
            for done, number in enumerate(frames, 1):
                if camera is None and has_markers:
                    # A camera that begins during the exposure begins with the next frame, as in Blender.
                    scene.frame_set(number)
                seen_by, taken = camera or scene.camera, []
                for time in _times(scene, number, samples):
                    whole = math.floor(time)
                    scene.frame_set(whole, subframe=time - whole)
                    frame = _RootTransform.of(root, scale)
                    scale = frame.scale
                    taken.append(_sample(scene, view_layer, seen_by, instances, frame, time, places))
                made.append(Frame(number, _shutter(scene, number, samples), taken))
                progress(done, len(frames))
    finally:
        scene.frame_set(before[0], subframe=before[1])
    _reset_unmoved([sample for frame in made for sample in frame.samples], instances)
    width, height = _size(scene)
    aspect = scene.render.pixel_aspect_x / scene.render.pixel_aspect_y
    return Shot(width, height, made, pixel_aspect=aspect, depth_scale=scale, only_named=True)


@dataclass(frozen=True)
class _RootTransform:
    """Similarity transform of a reconstruction, without nonuniform scale or shear of its parent empty.

    world = scale * rotation @ (capture - origin) + shift.
    """

    origin: np.ndarray
    rotation: np.ndarray
    scale: float
    shift: np.ndarray

    @classmethod
    def of(cls, root: bpy.types.Collection, scale: float | None) -> _RootTransform:
        """Return the transform at the current frame; `scale` is fixed per shot for depth, None uses the parent's."""
        world = np.array(world_of(parent_of(root)), np.float64)
        left, stretches, right = np.linalg.svd(world[:3, :3])
        if stretches[2] <= 1e-12 * stretches[0]:
            raise InputError(f"{root.name} is scaled to zero by its parent; set a scale other than zero.")
        left[:, 2] *= np.sign(np.linalg.det(left @ right))
        return cls(origin_of(root), left @ right, scale or float(np.cbrt(stretches.prod())), world[:3, 3])

    @cached_property
    def key(self) -> bytes:
        """The transform as bytes, which are the same for the same transform."""
        return b"".join(np.asarray(each).tobytes() for each in (self.origin, self.rotation, self.scale, self.shift))

    def map_from(self, world: np.ndarray, center: np.ndarray) -> np.ndarray:
        """Convert an object's world matrix to its transform in capture coordinates.

        Args:
            world: (4, 4) local to world.
            center: (3,) origin of its vertices in reconstruction coordinates.

        Returns:
            (4, 4), exactly the identity if the object is not moved.
        """
        linear = self.rotation.T @ world[:3, :3] / self.scale
        shift = self.rotation.T @ (world[:3, 3] - self.shift) / self.scale - linear @ center
        size = np.abs([*center, *self.shift / self.scale]).max() + 1e-30
        rotated = np.abs(linear - np.eye(3)).max() > TOLERANCE
        moved = np.abs(linear @ center + shift - center).max() > TOLERANCE * size
        found = np.eye(4)
        if rotated or moved:
            found[:3, :3], found[:3, 3] = linear, shift + self.origin - linear @ self.origin
        return found

    def viewmat(self, camera: np.ndarray) -> np.ndarray:
        """Return the (4, 4) map from capture to OpenCV camera coordinates; `camera`: world matrix without scale."""
        to_camera = _TO_OPENCV @ camera[:3, :3].T
        found = np.eye(4)
        found[:3, :3] = to_camera @ self.rotation
        found[:3, 3] = to_camera @ ((self.shift - camera[:3, 3]) / self.scale) - found[:3, :3] @ self.origin
        return found


class _Places:
    """Transforms of objects in capture coordinates, computed again only for those that have moved since the last time.

    Most objects of a scene rest, and a shot has many samples.
    """

    def __init__(self) -> None:
        self._known: dict[SplatsInstance, tuple[bytes, np.ndarray | None]] = {}

    def place(self, instance: SplatsInstance, transform: _RootTransform) -> np.ndarray | None:
        """Return an object's (4, 4) transform at the current frame; None if it has no volume."""
        world = instance.world()
        key = world.tobytes() + transform.key
        if instance not in self._known or self._known[instance][0] != key:
            place = transform.map_from(world, center_of(instance.pivot))
            self._known[instance] = key, None if is_singular(place) else place
        return self._known[instance][1]


def _reset_unmoved(samples: Sequence[Sample], instances: Sequence[SplatsInstance]) -> None:
    """Remove the transforms of objects that are not moved in any sample, and have no duplicates, even hidden ones.

    They keep their transforms of objects.json, which are those of the current frame if the scene shows the edits there,
    so objects that can move do not.
    """
    here = np.eye(4)[None]
    counts = Counter(instance.object_id for instance in instances)
    moving = {instance.object_id for instance in instances if counts[instance.object_id] > 1 or instance.can_move()}
    moving |= {
        object_id
        for sample in samples
        for object_id, placed in sample.objects.items()
        if not np.array_equal(placed.maps, here)
    }
    for sample in samples:
        for object_id in sample.objects.keys() - moving:
            sample.objects[object_id] = Placed()


def _sample(
    scene: bpy.types.Scene,
    view_layer: bpy.types.ViewLayer,
    camera: bpy.types.Object | None,
    instances: Any,
    transform: _RootTransform,
    time: float,
    places: _Places,
) -> Sample:
    objects: dict[int, list[np.ndarray]] = {}
    for instance in instances:
        if instance.is_seen():
            place = places.place(instance, transform)
            if place is not None:
                objects.setdefault(instance.object_id, []).append(place)
    if camera is None or camera.type != "CAMERA":
        raise InputError(f"The scene {scene.name} has no camera at frame {time:g}; choose one.")
    if camera.data.type != "PERSP":
        kind = _UNSUPPORTED.get(camera.data.type, "special")
        raise InputError(
            f"{camera.name} is {kind}, but splats can be rendered through perspective cameras only; choose one."
        )
    matrix = np.array(world_of(camera), np.float64)
    left, _, right = np.linalg.svd(matrix[:3, :3])
    matrix[:3, :3] = left @ right
    if np.linalg.det(matrix[:3, :3]) < 0:
        raise InputError(f"{camera.name} is mirrored by its scale or that of a parent; remove the negative scale.")
    clip = camera.data.clip_start / transform.scale, camera.data.clip_end / transform.scale
    placed = {object_id: Placed(maps=np.array(maps)) for object_id, maps in objects.items()}
    return Sample(time, transform.viewmat(matrix), _intrinsics(scene, view_layer, camera), clip, placed)


def _intrinsics(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer, camera: bpy.types.Object) -> np.ndarray:
    """Return K (3, 3) of the camera at the current frame, from Blender's projection matrix."""
    width, height = _size(scene)
    projection = camera.calc_matrix_camera(
        view_layer.depsgraph,
        x=width,
        y=height,
        scale_x=scene.render.pixel_aspect_x,
        scale_y=scene.render.pixel_aspect_y,
    )
    found = np.eye(3)
    found[0, 0], found[0, 2] = projection[0][0] * width / 2, (1 - projection[0][2]) * width / 2
    found[1, 1], found[1, 2] = projection[1][1] * height / 2, (1 + projection[1][2]) * height / 2
    return found


def _size(scene: bpy.types.Scene) -> tuple[int, int]:
    """Return the width and height of a render in pixels, rounded as in Blender."""
    render = scene.render
    return (
        max(render.resolution_x * render.resolution_percentage // 100, 1),
        max(render.resolution_y * render.resolution_percentage // 100, 1),
    )


def _shutter(scene: bpy.types.Scene, number: int, samples: int) -> tuple[float, float]:
    """Return the times at which the shutter opens and closes, in frames."""
    if samples == 1:
        return float(number), float(number)
    length = scene.render.motion_blur_shutter
    opens = number - {"START": 0.0, "CENTER": 0.5, "END": 1.0}[scene.render.motion_blur_position] * length
    return opens, opens + length


def _times(scene: bpy.types.Scene, number: int, samples: int) -> list[float]:
    opens, closes = _shutter(scene, number, samples)
    return [opens + (closes - opens) * (index + 0.5) / samples for index in range(samples)]
