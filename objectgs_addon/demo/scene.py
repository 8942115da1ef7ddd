# SPDX-License-Identifier: GPL-3.0-or-later
"""The demo scene: objects on a round table in a room, soft light, and cameras on two rings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix, Vector

from . import materials, shapes

FOCAL = 1.08  # Focal length / image width.
LOOK_AT = np.array([0.0, 0.0, 0.07])
RINGS = ((1.40, 0.47), (1.16, 0.98))  # Radius and height in meters.


@dataclass
class DemoObject:
    """An object of the scene with its ID."""

    id: int
    name: str
    object: bpy.types.Object


@dataclass
class View:
    """A camera: image name, and world-to-camera `rotation` (3, 3) and `translation` (3,) (OpenCV axes, meters)."""

    name: str
    rotation: np.ndarray
    translation: np.ndarray

    @property
    def center(self) -> np.ndarray:
        """Camera position in world coordinates, in meters."""
        return -self.rotation.T @ self.translation


def rng_for(seed: int, *key: int) -> np.random.Generator:
    """Return a separate random generator per key, so that random choices do not affect each other."""
    return np.random.default_rng([seed, *key])


def build(objects: int, seed: int) -> tuple[bpy.types.Scene, list[DemoObject]]:
    """Create a scene with `objects` objects on a table in a backdrop; IDs are 1..N, then table and backdrop."""
    scene = bpy.data.scenes.new("ObjectGS demo")
    kinds = list(shapes.MAKERS)
    objs, sizes = [], []
    for i in range(objects):
        kind, round_ = kinds[i % len(kinds)], i // len(kinds)
        name = kind if round_ == 0 else f"{kind}_{round_ + 1}"
        mesh = shapes.make(kind, scene)
        rng = rng_for(seed, 1, i)
        if round_:
            mesh.transform(Matrix.Scale(float(rng.uniform(0.75, 0.95)), 4))
        mesh.materials.append(materials.material(kind, rng))
        obj = DemoObject(i + 1, name, bpy.data.objects.new(name, mesh))
        scene.collection.objects.link(obj.object)
        objs.append(obj)
        sizes.append(_size(mesh))
    places, spread, scale = _arrange(np.array(sizes), seed)
    for obj, (x, y, turn) in zip(objs, places):
        matrix = Matrix.Translation((x, y, 0)) @ Matrix.Rotation(turn, 4, "Z") @ Matrix.Scale(scale, 4)
        obj.object.matrix_world = matrix
    for name, mesh, looks in (
        ("table", shapes.table(max(0.62, spread + 0.06)), [materials.table]),
        ("backdrop", shapes.backdrop(2.6), [materials.floor, materials.wall]),
    ):
        for i, look in enumerate(looks):
            mesh.materials.append(look(rng_for(seed, 2, len(objs), i)))
        obj = DemoObject(len(objs) + 1, name, bpy.data.objects.new(name, mesh))
        scene.collection.objects.link(obj.object)
        objs.append(obj)
    for obj in objs:
        obj.object.pass_index = obj.id
    pass_light(objs[-1])
    light(scene)
    return scene, objs


def pass_light(room: DemoObject) -> None:
    """Let the light of the world pass through a closed room."""
    obj = room.object
    obj.visible_diffuse = obj.visible_glossy = obj.visible_shadow = False


def _size(mesh: bpy.types.Mesh) -> tuple[float, float]:
    """Return a mesh's radius around the z axis and its height, in meters."""
    points = np.empty(len(mesh.vertices) * 3, np.float32)
    mesh.vertices.foreach_get("co", points)
    points = points.reshape(-1, 3)
    return float(np.hypot(points[:, 0], points[:, 1]).max()), float(points[:, 2].max())


def _arrange(sizes: np.ndarray, seed: int) -> Any:
    """Return dense placements (x, y, angle) without overlap and with tall objects inside, their radius, and a scale."""
    rng = rng_for(seed, 3)
    scale, limit = 1.0, 0.44
    while True:
        radius, height = sizes[:, 0] * scale, sizes[:, 1]
        best = None
        for _ in range(60):
            placed = _scatter(radius, height, limit, rng)
            if placed is None:
                continue
            # Prefer dense arrangements with tall objects near the center.
            cost = float((np.hypot(*placed.T) * (height + 0.05)).sum())
            if best is None or cost < best[0]:
                best = (cost, placed)
        if best is not None:
            places = np.column_stack([best[1], rng.uniform(0, 2 * math.pi, len(sizes))])
            spread = float((np.hypot(*best[1].T) + radius).max())
            return [tuple(map(float, p)) for p in places], spread, scale
        if scale * sizes[:, 1].min() > 0.085 and limit > 0.5:
            scale *= 0.95
        else:
            limit *= 1.04


def _scatter(radius: Any, height: Any, limit: Any, rng: Any) -> Any:
    placed = np.zeros((len(radius), 2))
    done: list[int] = []
    for i in np.argsort(-radius):
        for _ in range(200):
            r = (limit - radius[i] * 0.6) * math.sqrt(rng.random())
            a = rng.uniform(0, 2 * math.pi)
            spot = np.array([r * math.cos(a), r * math.sin(a)])
            if all(np.hypot(*(spot - placed[j])) > radius[i] + radius[j] + 0.006 for j in done):
                placed[i] = spot
                done.append(i)
                break
        else:
            return None
    return placed


def light(scene: bpy.types.Scene) -> None:
    world = bpy.data.worlds.new("demo")
    if world.node_tree is None:
        world.use_nodes = True
    tree = world.node_tree
    tree.nodes.clear()
    background = tree.nodes.new("ShaderNodeBackground")
    background.inputs[0].default_value = (0.86, 0.93, 1.0, 1.0)
    background.inputs[1].default_value = 0.62
    output = tree.nodes.new("ShaderNodeOutputWorld")
    tree.links.new(background.outputs[0], output.inputs[0])
    world.cycles.sampling_method = "NONE"  # A uniform sky is sampled best by bounced rays.
    scene.world = world
    for place, power, size, color in (((1.5, -1.2, 2.6), 85.0, 1.5, (1.0, 0.93, 0.82)),):
        lamp = bpy.data.lights.new("demo", "AREA")
        lamp.energy, lamp.size, lamp.color = power, size, color
        obj = bpy.data.objects.new("demo light", lamp)
        obj.matrix_world = Matrix.Translation(place) @ Vector(place).to_track_quat("Z", "Y").to_matrix().to_4x4()
        obj.visible_camera = False
        scene.collection.objects.link(obj)


def cameras(views: int, seed: int) -> list[View]:
    """Return cameras on two rings around the table, the low ring first, with small handheld-like random deviations."""
    rng = rng_for(seed, 4)
    low = (views + 1) // 2
    result = []
    for i in range(views):
        ring = 0 if i < low else 1
        count, j = (low, i) if ring == 0 else (views - low, i - low)
        angle = 2 * math.pi * (j + 0.5 * ring) / count + rng.normal(0, 0.02)
        radius, height = RINGS[ring]
        radius, height = radius * (1 + rng.normal(0, 0.02)), height + rng.normal(0, 0.015)
        center = np.array([radius * math.cos(angle), radius * math.sin(angle), height])
        target = LOOK_AT + rng.normal(0, 0.012, 3)
        result.append(look_at(i, center, target, rng.normal(0, 0.01)))
    return result


def look_at(index: int, center: np.ndarray, target: np.ndarray, roll: float = 0.0) -> View:
    """Return the camera number `index` at `center` (3,) that looks at `target` (3,), rolled by radians."""
    forward = target - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    right, down = (math.cos(roll) * right + math.sin(roll) * down, math.cos(roll) * down - math.sin(roll) * right)
    rotation = np.stack([right, down, forward])
    return View(f"{index:04d}.png", rotation, -rotation @ center)


def intrinsics(width: int, height: int) -> tuple[float, float, float, float]:
    """Return (fx, fy, cx, cy) in pixels."""
    return FOCAL * width, FOCAL * width, width / 2, height / 2


def triangles(obj: DemoObject) -> tuple[np.ndarray, np.ndarray]:
    """Return an object's vertices (V, 3) in world coordinates (meters) and its triangles (F, 3)."""
    mesh = obj.object.data
    mesh.calc_loop_triangles()
    points = np.empty(len(mesh.vertices) * 3, np.float32)
    mesh.vertices.foreach_get("co", points)
    faces = np.empty(len(mesh.loop_triangles) * 3, np.int32)
    mesh.loop_triangles.foreach_get("vertices", faces)
    matrix = np.array(obj.object.matrix_world)
    return points.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3], faces.reshape(-1, 3)


def remove(scene: bpy.types.Scene) -> None:
    """Remove the scene and all its data from the open file."""
    objects = list(scene.collection.all_objects)
    data = {o.data for o in objects if o.data is not None}
    looks = {m for d in data if isinstance(d, bpy.types.Mesh) for m in d.materials if m is not None}
    world = scene.world
    bpy.data.scenes.remove(scene)
    bpy.data.batch_remove([*objects, *data, *looks, *([world] if world is not None else [])])
