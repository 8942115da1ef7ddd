# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes of the demo's objects; each maker returns a new mesh in meters that stands on z = 0 around the z axis."""

from __future__ import annotations

import math
from typing import Any

import bmesh
import bpy
import numpy as np
from mathutils import Matrix, Vector


def _rounded(points: Any, times: int = 3) -> np.ndarray:
    """Round the corners of an open polyline by Chaikin's algorithm; both ends stay fixed."""
    line = np.asarray(points, float)
    for _ in range(times):
        a = 0.75 * line[:-1] + 0.25 * line[1:]
        b = 0.25 * line[:-1] + 0.75 * line[1:]
        line = np.concatenate([line[:1], np.stack([a, b], 1).reshape(-1, line.shape[1]), line[-1:]])
    return line


def from_faces(name: str, vertices: Any, faces: Any) -> bpy.types.Mesh:
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([tuple(map(float, v)) for v in vertices], [], faces)
    mesh.update()
    return mesh


def finish(mesh: bpy.types.Mesh, sharp_degrees: float = 40.0) -> bpy.types.Mesh:
    """Set smooth shading with sharp edges above an angle, and outward normals."""
    bm = bmesh.new()
    bm.from_mesh(mesh)
    bmesh.ops.recalc_face_normals(bm, faces=bm.faces)
    bm.to_mesh(mesh)
    bm.free()
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), bool))
    mesh.set_sharp_from_angle(angle=math.radians(sharp_degrees))
    mesh.update()
    return mesh


def lathe(name: str, profile: Any, segments: int = 64, lobes: int = 0, depth: float = 0.0, twist: float = 0.0) -> Any:
    """Create a surface of revolution around the z axis.

    Args:
        name: name of the mesh.
        profile: (P, 2) radii and heights in meters, with both ends on the axis.
        segments: number of segments around the axis.
        lobes: number of waves around the axis.
        depth: amplitude of the waves relative to the radius.
        twist: phase shift of the waves in radians per meter of height.
    """
    profile = np.asarray(profile, float)
    inner = profile[1:-1]
    angle = np.arange(segments) * (2 * math.pi / segments)
    wave = 1.0 + depth * np.cos(lobes * angle[None, :] + twist * inner[:, 1:2])
    radius = inner[:, :1] * wave
    height = np.broadcast_to(inner[:, 1:2], radius.shape)
    body = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1).reshape(-1, 3)
    vertices = np.concatenate([body, [[0, 0, profile[0, 1]], [0, 0, profile[-1, 1]]]])
    rows, first, last = len(inner), len(body), len(body) + 1
    faces = []
    for j in range(segments):
        k = (j + 1) % segments
        faces.append((first, k, j))
        faces.append((last, (rows - 1) * segments + j, (rows - 1) * segments + k))
        faces += [
            (i * segments + j, i * segments + k, (i + 1) * segments + k, (i + 1) * segments + j)
            for i in range(rows - 1)
        ]
    return from_faces(name, vertices, faces)


def tube(name: str, path: Any, radii: Any, segments: int = 20) -> Any:
    """Create a closed tube along a path (P, 3) in the xz plane, with a radius for each point."""
    path = np.asarray(path, float)
    radii = np.broadcast_to(np.asarray(radii, float), len(path))
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.array([0.0, 1.0, 0.0])
    normal = np.cross(tangent, side)
    angle = np.arange(segments) * (2 * math.pi / segments)
    around = np.cos(angle)[None, :, None] * side + np.sin(angle)[None, :, None] * normal[:, None, :]
    body = (path[:, None, :] + radii[:, None, None] * around).reshape(-1, 3)
    n = len(path)
    faces = [
        (
            i * segments + j,
            i * segments + (j + 1) % segments,
            (i + 1) * segments + (j + 1) % segments,
            (i + 1) * segments + j,
        )
        for i in range(n - 1)
        for j in range(segments)
    ]
    faces += [tuple(range(segments))[::-1], tuple((n - 1) * segments + j for j in range(segments))]
    return from_faces(name, body, faces)


def _union(meshes: Any, scene: bpy.types.Scene) -> bpy.types.Mesh:
    """Join overlapping closed meshes into one closed surface (exact boolean)."""
    objects = [bpy.data.objects.new("part", finish(m)) for m in meshes]
    layer = scene.view_layers[0]
    for part in objects:
        scene.collection.objects.link(part)
    for part in objects[1:]:
        modifier = objects[0].modifiers.new("union", "BOOLEAN")
        modifier.operation, modifier.solver, modifier.object = "UNION", "EXACT", part
    layer.update()
    graph = layer.depsgraph
    mesh = bpy.data.meshes.new_from_object(objects[0].evaluated_get(graph), depsgraph=graph)
    for part, old in zip(objects, meshes):
        bpy.data.objects.remove(part)
        bpy.data.meshes.remove(old)
    mesh.materials.clear()
    return mesh


def _from_bmesh(name: Any, build: Any) -> bpy.types.Mesh:
    bm = bmesh.new()
    build(bm)
    mesh = bpy.data.meshes.new(name)
    bm.to_mesh(mesh)
    bm.free()
    return mesh


def _bevelled_box(size: Any, corner: Any, matrix: Any = None) -> Any:
    def build(bm: bmesh.types.BMesh) -> None:
        bmesh.ops.create_cube(bm, size=1.0)
        bmesh.ops.scale(bm, vec=Vector(size), verts=bm.verts)
        bmesh.ops.bevel(bm, geom=list(bm.edges), offset=corner, segments=3, profile=0.5, affect="EDGES")
        if matrix is not None:
            bmesh.ops.transform(bm, matrix=matrix, verts=bm.verts)

    return _from_bmesh("box", build)


def _arc(center: Any, radius_x: Any, radius_z: Any, start: Any, stop: Any, steps: Any = 20) -> Any:
    t = np.radians(np.linspace(start, stop, steps))
    return np.stack([center[0] + radius_x * np.cos(t), np.zeros(steps), center[1] + radius_z * np.sin(t)], 1)


def mug(scene: bpy.types.Scene) -> bpy.types.Object:
    """Create a mug with a handle, 15 cm high."""
    body = lathe(
        "mug",
        _rounded(
            [
                (0, 0),
                (0.055, 0),
                (0.060, 0.004),
                (0.060, 0.02),
                (0.060, 0.14),
                (0.059, 0.15),
                (0.054, 0.15),
                (0.053, 0.14),
                (0.053, 0.02),
                (0.050, 0.012),
                (0, 0.012),
            ]
        ),
    )
    handle = tube("handle", _arc((0.056, 0.076), 0.052, 0.048, -90, 90), 0.0105)
    return _union([body, handle], scene)


def bottle(scene: bpy.types.Scene) -> bpy.types.Object:
    """Create a bottle with a long neck, 36 cm high."""
    return lathe(
        "bottle",
        _rounded(
            [
                (0, 0),
                (0.052, 0),
                (0.056, 0.006),
                (0.056, 0.03),
                (0.056, 0.19),
                (0.054, 0.22),
                (0.022, 0.25),
                (0.020, 0.28),
                (0.020, 0.335),
                (0.025, 0.337),
                (0.025, 0.36),
                (0.016, 0.36),
                (0, 0.36),
            ]
        ),
    )


def ring(scene: bpy.types.Scene) -> bpy.types.Object:
    """Create a ring (torus) standing on its edge, 24 cm high."""
    angle = np.arange(64) * (2 * math.pi / 64)
    small = np.arange(28) * (2 * math.pi / 28)
    big = 0.085 + 0.035 * np.cos(small)[None, :]
    points = np.stack(
        [
            big * np.cos(angle)[:, None],
            np.broadcast_to(0.035 * np.sin(small), (64, 28)),
            big * np.sin(angle)[:, None] + 0.1195,
        ],
        -1,
    ).reshape(-1, 3)
    faces = [
        (i * 28 + j, i * 28 + (j + 1) % 28, (i + 1) % 64 * 28 + (j + 1) % 28, (i + 1) % 64 * 28 + j)
        for i in range(64)
        for j in range(28)
    ]
    return from_faces("ring", points, faces)


def bowl(scene: bpy.types.Scene) -> bpy.types.Object:
    """Create a bowl, 26 cm wide."""
    return lathe(
        "bowl",
        _rounded(
            [
                (0, 0),
                (0.05, 0),
                (0.052, 0.012),
                (0.075, 0.02),
                (0.115, 0.055),
                (0.13, 0.10),
                (0.123, 0.102),
                (0.108, 0.06),
                (0.07, 0.03),
                (0, 0.025),
            ]
        ),
    )


def books(scene: bpy.types.Scene) -> bpy.types.Object:
    """Create a stack of three books, 24 cm wide and 13 cm high."""
    stack, z = [], 0.0
    for size, turn in (((0.24, 0.17, 0.05), 0.0), ((0.22, 0.155, 0.04), 0.22), ((0.19, 0.14, 0.045), -0.30)):
        matrix = Matrix.Translation((0, 0, z + size[2] / 2)) @ Matrix.Rotation(turn, 4, "Z")
        stack.append(_bevelled_box(size, 0.004, matrix))
        z += size[2] - 0.001
    return _union(stack, scene)


def monkey(scene: bpy.types.Scene) -> bpy.types.Object:
    """Create Blender's monkey, smoothed, 24 cm high."""
    base = _from_bmesh("monkey", lambda bm: bmesh.ops.create_monkey(bm))
    part = bpy.data.objects.new("part", base)
    scene.collection.objects.link(part)
    part.modifiers.new("smooth", "SUBSURF").levels = 2
    layer = scene.view_layers[0]
    layer.update()
    mesh = bpy.data.meshes.new_from_object(part.evaluated_get(layer.depsgraph), depsgraph=layer.depsgraph)
    bpy.data.objects.remove(part)
    bpy.data.meshes.remove(base)
    mesh.transform(Matrix.Rotation(math.radians(68), 4, "X"))
    return _stand(mesh, 0.24)


def teapot(scene: bpy.types.Scene) -> bpy.types.Object:
    """Create a teapot with spout, handle and lid, 18 cm high."""
    body = lathe(
        "teapot",
        _rounded(
            [
                (0, 0),
                (0.06, 0),
                (0.07, 0.006),
                (0.10, 0.04),
                (0.105, 0.085),
                (0.075, 0.125),
                (0.06, 0.132),
                (0.05, 0.145),
                (0.018, 0.15),
                (0.012, 0.158),
                (0.02, 0.168),
                (0.018, 0.18),
                (0, 0.181),
            ]
        ),
    )
    path = _rounded([(0.08, 0, 0.05), (0.12, 0, 0.055), (0.15, 0, 0.09), (0.165, 0, 0.125), (0.185, 0, 0.135)])
    spout = tube("spout", path, np.linspace(0.026, 0.013, len(path)))
    handle = tube("handle", _arc((-0.088, 0.075), 0.065, 0.042, 90, 270), 0.011)
    return _union([body, spout, handle], scene)


def vase(scene: bpy.types.Scene) -> bpy.types.Object:
    """Create a vase with twisted lobes, 38 cm high."""
    profile = _rounded(
        [
            (0, 0),
            (0.055, 0),
            (0.06, 0.01),
            (0.085, 0.09),
            (0.09, 0.16),
            (0.06, 0.26),
            (0.042, 0.31),
            (0.055, 0.365),
            (0.062, 0.38),
            (0.054, 0.382),
            (0.036, 0.32),
            (0.036, 0.28),
            (0, 0.27),
        ]
    )
    return lathe("vase", profile, segments=96, lobes=8, depth=0.07, twist=7.0)


def cone(scene: bpy.types.Scene) -> bpy.types.Object:
    """Create a blunt cone, 26 cm high."""
    return lathe(
        "cone", _rounded([(0, 0), (0.095, 0), (0.10, 0.004), (0.098, 0.012), (0.015, 0.25), (0.008, 0.26), (0, 0.261)])
    )


def ball(scene: bpy.types.Scene) -> bpy.types.Object:
    """Create a ball with a diameter of 18 cm."""
    mesh = _from_bmesh("ball", lambda bm: bmesh.ops.create_icosphere(bm, subdivisions=5, radius=0.09))
    return _stand(mesh, 0.18)


def die(scene: bpy.types.Scene) -> bpy.types.Object:
    """Create a cube with rounded corners, 15 cm."""
    return _bevelled_box((0.15, 0.15, 0.15), 0.018, Matrix.Translation((0, 0, 0.075)))


def pumpkin(scene: bpy.types.Scene) -> bpy.types.Object:
    """Create a ribbed pumpkin, 16 cm high."""
    profile = _rounded(
        [
            (0, 0.012),
            (0.04, 0),
            (0.10, 0.02),
            (0.115, 0.07),
            (0.09, 0.12),
            (0.03, 0.13),
            (0.016, 0.135),
            (0.013, 0.155),
            (0.015, 0.16),
            (0, 0.161),
        ]
    )
    return lathe("pumpkin", profile, segments=96, lobes=9, depth=0.06)


def mushroom(scene: bpy.types.Scene) -> bpy.types.Object:
    """Create a mushroom, 20 cm high."""
    return lathe(
        "mushroom",
        _rounded(
            [
                (0, 0),
                (0.045, 0),
                (0.05, 0.02),
                (0.033, 0.06),
                (0.035, 0.10),
                (0.05, 0.108),
                (0.11, 0.10),
                (0.115, 0.125),
                (0.08, 0.185),
                (0.03, 0.20),
                (0, 0.20),
            ]
        ),
    )


def gear(scene: bpy.types.Scene) -> bpy.types.Object:
    """Create a thick gear lying flat, 24 cm wide."""
    return lathe(
        "gear",
        [
            (0, 0),
            (0.10, 0),
            (0.104, 0.004),
            (0.104, 0.076),
            (0.10, 0.08),
            (0.05, 0.08),
            (0.046, 0.076),
            (0.044, 0.05),
            (0, 0.05),
        ],
        segments=120,
        lobes=10,
        depth=0.09,
    )


MAKERS = {
    maker.__name__: maker
    for maker in (mug, bottle, ring, bowl, books, monkey, teapot, vase, cone, ball, die, pumpkin, mushroom, gear)
}


def make(kind: str, scene: bpy.types.Scene) -> bpy.types.Mesh:
    """Create the mesh of a kind of object (a key of `MAKERS`); `scene` temporarily holds parts for modifiers."""
    return finish(MAKERS[kind](scene))


def table(radius: float) -> bpy.types.Mesh:
    """Create a round table on one foot, with its top of `radius` meters at z = 0."""
    top = _rounded(
        [(0.16, -0.045), (radius - 0.02, -0.045), (radius, -0.038), (radius, -0.006), (radius - 0.006, 0)], 2
    )
    foot = _rounded([(0.30, -0.70), (0.30, -0.68), (0.10, -0.62), (0.06, -0.5), (0.06, -0.15), (0.16, -0.05)], 2)
    rings = [(r, 0.0) for r in np.linspace(radius - 0.02, 0.02, 24)]
    return finish(lathe("table", [(0, -0.70), *foot, *top, *rings, (0, 0)], segments=96), 30)


def backdrop(radius: float) -> bpy.types.Mesh:
    """Create a closed room of `radius` meters without corners and with inward normals.

    The floor at z = -0.7 has material 0; the wall and dome have material 1.
    """
    z, top = -0.70, 2.4
    line = _rounded(
        [
            (radius - 0.55, z),
            (radius - 0.1, z),
            (radius, z + 0.15),
            (radius, 0.6),
            (radius, 1.2),
            (radius * 0.8, top - 0.3),
            (radius * 0.4, top),
        ],
        3,
    )
    floor = [(r, z) for r in np.linspace(0.1, radius - 0.6, 20)]
    mesh = finish(lathe("backdrop", [(0, z), *floor, *line, (0, top)], segments=128))
    mesh.flip_normals()
    for face in mesh.polygons:
        face.material_index = int(face.center.z > z + 0.02)
    return mesh


def _stand(mesh: bpy.types.Mesh, height: float) -> bpy.types.Mesh:
    """Scale a mesh to a height in meters, and move its lowest point to z = 0 and its center to the axis."""
    points = np.empty(len(mesh.vertices) * 3, np.float32)
    mesh.vertices.foreach_get("co", points)
    low, high = points.reshape(-1, 3).min(0), points.reshape(-1, 3).max(0)
    scale = height / float(high[2] - low[2])
    middle = Vector(((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]))
    mesh.transform(Matrix.Scale(scale, 4) @ Matrix.Translation(-middle))
    return mesh
