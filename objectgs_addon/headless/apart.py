# SPDX-License-Identifier: GPL-3.0-or-later
"""Exploded view of the objects' meshes, lifted and moved outward from the center, in soft light."""

from __future__ import annotations

import math

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ...backend.shared.errors import InputError
from .. import scene
from ..scene.shading.graph import Graph

SIZE = (960, 600)
SAMPLES = 32
"""Samples per pixel; enough for a good image within half a minute on two CPU cores."""
LARGE = 2.5
"""Size, relative to the median, above which objects such as tables are not moved."""

OUTWARD = 0.7
"""Outward movement of objects, relative to their horizontal distance from the center."""
LIFT = 0.35
"""Upward movement of objects, relative to the median size."""

LENS = 60.0
SENSOR = 36.0
ELEVATION = math.radians(27.0)
MARGIN = 1.08

GROUND = (0.78, 0.78, 0.78)
SKY = 0.5
SUN = 2.2
SUN_ANGLE = math.radians(20.0)
"""Angular diameter of the sun, which softens the shadows."""


def reconstructions(target: bpy.types.Scene) -> list[bpy.types.Collection]:
    """Return the collections of the reconstructions in a scene."""
    return [child for child in target.collection.children_recursive if scene.kind_of(child) == "reconstruction"]


def add_even_light(target: bpy.types.Scene) -> None:
    """Add uniform white light, which shows the unmodified colors of textures, and a black background."""
    world = target.world = bpy.data.worlds.new("ObjectGS Light")
    _light_evenly(world, 1.0, behind=0.0)


def pull_apart(target: bpy.types.Scene) -> None:
    """Pull the objects' meshes of a scene apart, and add lights, ground and camera, for a render that is not saved.

    Large objects are not moved; large objects that enclose most others, such as a room, are hidden.

    Raises:
        InputError: the scene has no meshes of objects.
    """
    found = [(root, _seen_meshes(root)) for root in reconstructions(target)]
    found = [(root, meshes) for root, meshes in found if meshes]
    if not found:
        raise InputError("There are no meshes to pull apart; make them with the mesh command, then build again.")
    root, meshes = found[0]
    scene.show_kinds(root, "meshes")
    target.view_layers[0].update()
    boxes = {object_id: scene.bounds(objs) for object_id, objs in meshes.items()}
    sizes = {object_id: float(np.linalg.norm(high - low)) for object_id, (low, high) in boxes.items()}
    middle_size = float(np.median(list(sizes.values())))
    large = {object_id for object_id, size in sizes.items() if size > LARGE * middle_size}
    moved = sorted(set(boxes) - large)
    middles = np.array([boxes[object_id].mean(0) for object_id in moved])
    around = {object_id for object_id in large if _contains(boxes[object_id], middles)}
    _show_only(target, [obj for object_id, objs in meshes.items() if object_id not in around for obj in objs])

    center = np.append(np.median(middles[:, :2], axis=0), 0.0)
    shown = {object_id: boxes[object_id] for object_id in large - around}
    for object_id, middle in zip(moved, middles):
        step = OUTWARD * (middle - center) * (1.0, 1.0, 0.0) + (0.0, 0.0, LIFT * middle_size)
        _move(meshes[object_id], step)
        shown[object_id] = boxes[object_id] + step
    low = min(box[0][2] for box in [*shown.values(), *(boxes[object_id] for object_id in moved)])
    extent = float(np.linalg.norm(np.ptp(np.concatenate(list(shown.values())), axis=0)))
    _add_ground(target, Vector((*center[:2], low)), 40.0 * extent)
    target.render.pixel_aspect_x = target.render.pixel_aspect_y = 1.0
    corners = np.stack([_corners(shown[object_id]) for object_id in moved])
    toward = _best_direction(root, corners)
    _add_camera(target, toward, corners.reshape(-1, 3))
    _add_light(target, toward)
    target.cycles.use_denoising = True
    target.cycles.adaptive_threshold = 0.05
    target.cycles.max_bounces = 2


def _seen_meshes(root: bpy.types.Collection) -> dict[int, list[bpy.types.Object]]:
    """Return object ID -> meshes for objects that are not removed."""
    collections = scene.object_collections(root)
    return {
        object_id: meshes
        for object_id, meshes in scene.object_meshes(root).items()
        if not scene.is_removed(collections[object_id])
    }


def _corners(box: np.ndarray) -> np.ndarray:
    """Return the corners (8, 3) of a box (2, 3)."""
    return np.array([[box[i][0], box[j][1], box[k][2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


def _contains(box: np.ndarray, points: np.ndarray) -> bool:
    """Return whether most of the points (n, 3) are in a box (2, 3)."""
    return float(((points > box[0]) & (points < box[1])).all(1).mean()) > 0.5


def _show_only(target: bpy.types.Scene, meshes: list[bpy.types.Object]) -> None:
    shown = set(meshes)
    for obj in target.objects:
        obj.hide_render = obj not in shown


def _move(objs: list[bpy.types.Object], step: np.ndarray) -> None:
    for obj in objs:
        obj.matrix_world = Matrix.Translation(step) @ obj.matrix_world


def _add_ground(target: bpy.types.Scene, center: Vector, size: float) -> None:
    mesh = bpy.data.meshes.new("Ground")
    corners = [center + size * Vector(corner) for corner in ((-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0))]
    mesh.from_pydata(corners, [], [(0, 1, 2, 3)])
    material = bpy.data.materials.new("Ground")
    if material.node_tree is None:
        material.use_nodes = True
    material.node_tree.nodes.clear()
    graph = Graph(material.node_tree)
    shader = graph.node("ShaderNodeBsdfDiffuse", {"Color": (*GROUND, 1.0)}).outputs[0]
    graph.node("ShaderNodeOutputMaterial", {"Surface": shader})
    mesh.materials.append(material)
    target.collection.objects.link(bpy.data.objects.new("Ground", mesh))


def _best_direction(root: bpy.types.Collection, corners: np.ndarray) -> Vector:
    """Return the view direction, from the side of a camera, that minimizes the overlap of the boxes (n, 8, 3)."""
    center = (corners.min((0, 1)) + corners.max((0, 1))) / 2
    camera_centers = [obj.matrix_world.translation for obj in root.all_objects if scene.kind_of(obj) == "camera"]
    sides = [
        Vector((camera_center.x - center[0], camera_center.y - center[1]))
        for camera_center in camera_centers[:: max(1, len(camera_centers) // 50)]
    ]
    sides = [side.normalized() for side in sides if side.length > 1e-6] or [Vector((0.0, -1.0))]
    directions = [-Vector((*(side * math.cos(ELEVATION)), math.sin(ELEVATION))) for side in sides]

    def in_view(toward: Vector) -> float:
        seen = (corners @ np.array(toward.to_track_quat("-Z", "Y").to_matrix()))[..., :2]
        low, high = seen.min(1), seen.max(1)
        both = np.clip(np.minimum(high[:, None], high) - np.maximum(low[:, None], low), 0.0, None).prod(2)
        # Up to a constant: the area of all boxes minus the overlaps of all pairs, twice.
        return float(2.0 * np.trace(both) - both.sum())

    return max(directions, key=in_view)


def _add_camera(target: bpy.types.Scene, toward: Vector, corners: np.ndarray) -> None:
    """Add a camera that looks `toward` and has all `corners` (n, 3) in view."""
    center = Vector((corners.min(0) + corners.max(0)) / 2)
    rotation = toward.to_track_quat("-Z", "Y")
    # Coordinates to the right, up and toward the camera. Find the nearest position from which all corners are in view.
    seen = (corners - np.array(center)) @ np.array(rotation.to_matrix())
    half = np.array([1.0, target.render.resolution_y / target.render.resolution_x]) * SENSOR / LENS / 2.0 / MARGIN
    x = y = 0.0
    for _ in range(20):
        need = np.abs(seen[:, :2] - (x, y)) / half + seen[:, 2:]
        distance = need.max()
        # Center the projected corners, not the box.
        screen = (seen[:, :2] - (x, y)) / (distance - seen[:, 2:])
        shift = (screen.min(0) + screen.max(0)) / 2.0 * distance
        x, y = x + shift[0], y + shift[1]
    camera = bpy.data.cameras.new("Apart")
    camera.sensor_fit, camera.sensor_width, camera.lens = "HORIZONTAL", SENSOR, LENS
    camera.clip_start, camera.clip_end = 0.01 * distance, 100.0 * distance
    obj = bpy.data.objects.new("Apart", camera)
    obj.rotation_mode = "QUATERNION"
    obj.rotation_quaternion = rotation
    obj.location = center + rotation @ Vector((x, y, distance))
    target.collection.objects.link(obj)
    target.camera = obj


def _add_light(target: bpy.types.Scene, toward: Vector) -> None:
    """Add a soft sun light from behind the camera on the left, and a sky."""
    heading = math.atan2(toward.y, toward.x)
    sun = bpy.data.lights.new("Apart", "SUN")
    sun.energy, sun.angle = SUN, SUN_ANGLE
    obj = bpy.data.objects.new("Apart Sun", sun)
    aside = heading - math.radians(50.0)
    down = Vector((math.cos(aside), math.sin(aside), -1.4))
    obj.rotation_mode = "QUATERNION"
    obj.rotation_quaternion = down.to_track_quat("-Z", "Y")
    target.collection.objects.link(obj)
    target.world = bpy.data.worlds.new("Apart")
    _light_evenly(target.world, SKY, behind=SKY)
    target.render.film_transparent = False


def _light_evenly(world: bpy.types.World, strength: float, behind: float) -> None:
    """Set up a uniform white world.

    Args:
        world: the world to change.
        strength: strength of its light.
        behind: strength of the background in the image.
    """
    if world.node_tree is None:
        world.use_nodes = True
    world.node_tree.nodes.clear()
    graph = Graph(world.node_tree)
    camera = graph.node("ShaderNodeLightPath").outputs["Is Camera Ray"]
    light = graph.math("MULTIPLY_ADD", camera, behind - strength, strength)
    sky = graph.node("ShaderNodeBackground", {"Color": (1.0, 1.0, 1.0, 1.0), "Strength": light}).outputs[0]
    graph.node("ShaderNodeOutputWorld", {"Surface": sky})
    graph.arrange()
