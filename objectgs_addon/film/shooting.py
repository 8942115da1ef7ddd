# SPDX-License-Identifier: GPL-3.0-or-later
"""A scene's camera and a reconstruction's objects, moment by moment, as a shot in the capture's coordinates.

What is seen is what Blender would render: the splats of every object whose collections, pivot and parts are not hidden
for rendering. The reconstruction's own collection does not count, since it is hidden where the compositor joins film
frames with Blender's rendering. What stays in Blender where it was captured is where objects.json says.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Matrix

from ...backend.film.shot import Frame, Placed, Sample, Shot
from ...backend.protocol import InputError
from ..scene.capture import origin_of
from ..scene.kinds import MESH, OBJECT_PARENT, SPLATS, kind_of, object_id_of, parent_of, part_of
from ..scene.object_collection import centre_of

SAME = 2e-6
"""A map that differs less from none, relative to where things are, is none: Blender counts in float32."""

_TO_OPENCV = np.diag([1.0, -1.0, -1.0])
_REFUSED = {"ORTHO": "orthographic", "PANO": "panoramic"}


def shot_of(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer, root: bpy.types.Collection,
            frames: Sequence[int], samples: int = 1,
            progress: Callable[[int, int], object] = lambda done, total: None) -> Shot:
    """Frames of the scene as a shot of a reconstruction.

    samples: moments of a frame while the shutter is open, as the scene's motion blur says when that is; 1: the frame's
    own moment. progress(done, total) is called after every frame. The scene is as before afterwards. Raises InputError
    where there is no camera, or one through which splats cannot be drawn.
    """
    if parent_of(root) is None:
        raise InputError(f"{root.name} has lost the empty that moves it; run Import again.")
    if not frames or frames[0] < 0:
        raise InputError("The first frame is below 0, which files in a sequence cannot be numbered by; move the shot.")
    actors = _actors(scene, view_layer, root)
    before = scene.frame_current, scene.frame_subframe
    made, scale = [], None
    try:
        with _awake(view_layer, actors):
            for done, number in enumerate(frames, 1):
                taken = []
                for time in _times(scene, number, samples):
                    whole = math.floor(time)
                    scene.frame_set(whole, subframe=time - whole)
                    frame = _Place.of(root, scale)
                    scale = frame.scale
                    taken.append(_sample(scene, view_layer, actors, frame, time))
                made.append(Frame(number, _shutter(scene, number, samples), taken))
                progress(done, len(frames))
    finally:
        scene.frame_set(before[0], subframe=before[1])
    _leave_still_ones([sample for frame in made for sample in frame.samples])
    width, height = _size(scene)
    aspect = scene.render.pixel_aspect_x / scene.render.pixel_aspect_y
    return Shot(width, height, made, pixel_aspect=aspect, depth_scale=scale, only_named=True)


@dataclass(frozen=True)
class _Place:
    """Where a reconstruction stands: world = scale * turn @ (capture - origin) + shift, without what else its parent
    does to it."""

    origin: np.ndarray
    turn: np.ndarray
    scale: float
    shift: np.ndarray

    @classmethod
    def of(cls, root, scale: float | None) -> "_Place":
        """scale: one for a whole shot, since depth is counted in it; None: the parent's."""
        world = np.array(_world_of(parent_of(root)), np.float64)
        left, stretches, right = np.linalg.svd(world[:3, :3])
        if stretches[2] <= 1e-12 * stretches[0]:
            raise InputError(f"{root.name} is scaled to nothing by its parent; give it a size again.")
        left[:, 2] *= np.sign(np.linalg.det(left @ right))
        return cls(origin_of(root), left @ right, scale or float(np.cbrt(stretches.prod())), world[:3, 3])

    def map_from(self, world: np.ndarray, centre: np.ndarray) -> np.ndarray:
        """(4, 4) of the capture's coordinates: what moves an object, whose vertices count from `centre`, to where
        its matrix in the world has it."""
        linear = self.turn.T @ world[:3, :3] / self.scale
        shift = self.turn.T @ (world[:3, 3] - self.shift) / self.scale - linear @ centre
        size = np.abs([*centre, *self.shift / self.scale]).max() + 1e-30
        turned = np.abs(linear - np.eye(3)).max() > SAME
        went = np.abs(linear @ centre + shift - centre).max() > SAME * size
        found = np.eye(4)
        if turned or went:
            found[:3, :3], found[:3, 3] = linear, shift + self.origin - linear @ self.origin
        return found

    def viewmat(self, camera: np.ndarray) -> np.ndarray:
        """(4, 4) from the capture's coordinates to OpenCV's of a camera, given its matrix without scale."""
        to_camera = _TO_OPENCV @ camera[:3, :3].T
        found = np.eye(4)
        found[:3, :3] = to_camera @ self.turn
        found[:3, 3] = to_camera @ ((self.shift - camera[:3, 3]) / self.scale) - found[:3, :3] @ self.origin
        return found


@dataclass(frozen=True)
class _Actor:
    """Splats in the scene: their object's ID, where their vertices count from, what must not be hidden, and what else
    shows the same object; instancer: an empty that shows the collection they are in elsewhere."""

    object_id: int
    splats: bpy.types.Object
    pivot: bpy.types.Object
    parts: tuple
    paths: tuple
    instancer: bpy.types.Object | None = None

    def is_seen(self) -> bool:
        """Whether Blender would render it now, if the whole reconstruction was not hidden."""
        top = self.instancer or self.pivot
        shown = any(not part.hide_render for part in self.parts)
        return shown and not top.hide_render and any(
            all(not layer.exclude and not layer.collection.hide_render for layer in path) for path in self.paths)

    def world(self) -> np.ndarray:
        """(4, 4) float64, now."""
        world = _world_of(self.splats)
        if self.instancer is not None:
            offset = Matrix.Translation(-self.instancer.instance_collection.instance_offset)
            world = _world_of(self.instancer) @ offset @ world
        return np.array(world, np.float64)


def _leave_still_ones(samples: Sequence[Sample]) -> None:
    """Say nothing of where objects are that are where they were captured in all samples."""
    here = np.eye(4)[None]
    moving = {object_id for sample in samples for object_id, placed in sample.objects.items()
              if not np.array_equal(placed.maps, here)}
    for sample in samples:
        for object_id in sample.objects.keys() - moving:
            sample.objects[object_id] = Placed()


def _actors(scene, view_layer, root) -> list[_Actor]:
    paths = _paths(view_layer, root)
    parent = parent_of(root)
    ours = [thing for thing in scene.objects if kind_of(thing) == SPLATS and _hangs_on(thing, parent)]
    found = [actor for thing in ours if (actor := _actor(thing, paths)) is not None]
    for instancer in scene.objects:
        if instancer.instance_type == "COLLECTION" and instancer.instance_collection is not None:
            for thing in instancer.instance_collection.all_objects:
                if kind_of(thing) == SPLATS and _hangs_on(thing, parent):
                    found.append(_actor(thing, paths, instancer))
    return [actor for actor in found if actor is not None]


def _actor(thing, paths, instancer=None) -> _Actor | None:
    collections = list(thing.users_collection)
    pivot = thing.parent if kind_of(thing.parent) == OBJECT_PARENT else next(
        (pivot for collection in collections if (pivot := part_of(collection, OBJECT_PARENT)) is not None), None)
    object_id = object_id_of(thing)
    if pivot is None or object_id is None:
        return None
    meshes = [part for part in pivot.children if kind_of(part) == MESH]
    top = instancer or thing
    of_top = [path for collection in top.users_collection for path in paths.get(collection, ())]
    return _Actor(object_id, thing, pivot, (thing, *meshes), tuple(of_top), instancer)


def _paths(view_layer, root) -> dict:
    """Collection -> the ways from the top to it in a view layer, as lists of layer collections without the root's."""
    found: dict = {}

    def walk(layer, path):
        if layer.collection != root:
            path = [*path, layer]
        found.setdefault(layer.collection, []).append(path)
        for child in layer.children:
            walk(child, path)

    walk(view_layer.layer_collection, [])
    return found


def _hangs_on(thing, parent) -> bool:
    while thing is not None and thing != parent:
        thing = thing.parent
    return thing is not None


def _world_of(thing) -> Matrix:
    """An object's place; of one that viewports do not show, and Blender therefore does not keep up, by its parent's."""
    if thing.visible_get() or thing.parent is None or thing.parent_type != "OBJECT":
        return thing.matrix_world
    return _world_of(thing.parent) @ thing.matrix_parent_inverse @ thing.matrix_basis


@contextmanager
def _awake(view_layer, actors) -> Iterator[None]:
    """Show pivots that move by themselves in viewports meanwhile, since Blender moves nothing that is hidden there."""
    asleep = {actor.pivot: actor for actor in actors
              if (actor.pivot.animation_data or actor.pivot.constraints) and not actor.pivot.visible_get()}
    changed = []

    def show(thing):
        changed.append((thing, thing.hide_viewport))
        thing.hide_viewport = False

    hidden = []
    for pivot, actor in asleep.items():
        for path in actor.paths:
            for layer in path:
                show(layer)
                show(layer.collection)
        show(pivot)
        if pivot.hide_get(view_layer=view_layer):
            hidden.append(pivot)
            pivot.hide_set(False, view_layer=view_layer)
    try:
        yield
    finally:
        for pivot in hidden:
            pivot.hide_set(True, view_layer=view_layer)
        for thing, before in reversed(changed):
            thing.hide_viewport = before


def _sample(scene, view_layer, actors, place: _Place, time: float) -> Sample:
    objects: dict[int, list[np.ndarray]] = {}
    for actor in actors:
        if actor.is_seen():
            objects.setdefault(actor.object_id, []).append(place.map_from(actor.world(), centre_of(actor.pivot)))
    camera = scene.camera
    if camera is None or camera.type != "CAMERA":
        raise InputError(f"The scene {scene.name} has no camera at frame {time:g}; choose one.")
    if camera.data.type != "PERSP":
        kind = _REFUSED.get(camera.data.type, "special")
        raise InputError(f"{camera.name} is {kind}, and splats can be drawn through perspective cameras only; "
                         "choose one.")
    matrix = np.array(_world_of(camera).normalized(), np.float64)
    clip = camera.data.clip_start / place.scale, camera.data.clip_end / place.scale
    placed = {object_id: Placed(maps=np.array(maps)) for object_id, maps in objects.items()}
    return Sample(time, place.viewmat(matrix), _intrinsics(scene, view_layer, camera), clip, placed)


def _intrinsics(scene, view_layer, camera) -> np.ndarray:
    """K (3, 3) of the scene's camera now, from Blender's own projection."""
    width, height = _size(scene)
    projection = camera.calc_matrix_camera(
        view_layer.depsgraph, x=width, y=height, scale_x=scene.render.pixel_aspect_x,
        scale_y=scene.render.pixel_aspect_y)
    found = np.eye(3)
    found[0, 0], found[0, 2] = projection[0][0] * width / 2, (1 - projection[0][2]) * width / 2
    found[1, 1], found[1, 2] = projection[1][1] * height / 2, (1 + projection[1][2]) * height / 2
    return found


def _size(scene) -> tuple[int, int]:
    """Pixels of a render, rounded as Blender does."""
    render = scene.render
    return (max(render.resolution_x * render.resolution_percentage // 100, 1),
            max(render.resolution_y * render.resolution_percentage // 100, 1))


def _shutter(scene, number: int, samples: int) -> tuple[float, float]:
    """When the shutter opens and closes."""
    if samples == 1:
        return float(number), float(number)
    length = scene.render.motion_blur_shutter
    opens = number - {"START": 0.0, "CENTER": 0.5, "END": 1.0}[scene.render.motion_blur_position] * length
    return opens, opens + length


def _times(scene, number: int, samples: int) -> list[float]:
    opens, closes = _shutter(scene, number, samples)
    return [opens + (closes - opens) * (index + 0.5) / samples for index in range(samples)]
