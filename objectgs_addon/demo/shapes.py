# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes of the demo's objects.  Every maker returns a new mesh in metres that stands on z = 0 around the z axis."""

import math

import bmesh
import bpy
import numpy as np
from mathutils import Matrix, Vector


def _rounded(points, times: int = 3) -> np.ndarray:
    """Cut the corners of an open polyline (Chaikin); both ends stay."""
    line = np.asarray(points, float)
    for _ in range(times):
        a = 0.75 * line[:-1] + 0.25 * line[1:]
        b = 0.25 * line[:-1] + 0.75 * line[1:]
        line = np.concatenate([line[:1], np.stack([a, b], 1).reshape(-1, line.shape[1]), line[-1:]])
    return line


def _mesh(name: str, vertices, faces) -> bpy.types.Mesh:
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([tuple(map(float, v)) for v in vertices], [], faces)
    mesh.update()
    return mesh


def _finish(mesh, sharp_degrees: float = 40.0) -> bpy.types.Mesh:
    """Smooth shading with sharp edges above an angle, normals outwards."""
    bm = bmesh.new()
    bm.from_mesh(mesh)
    bmesh.ops.recalc_face_normals(bm, faces=bm.faces)
    bm.to_mesh(mesh)
    bm.free()
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), bool))
    mesh.set_sharp_from_angle(angle=math.radians(sharp_degrees))
    mesh.update()
    return mesh


def lathe(name: str, profile, segments: int = 64, lobes: int = 0, depth: float = 0.0, twist: float = 0.0):
    """Turn a profile of (radius, height) metres, both ends on the axis, around z; `lobes` waves of relative `depth`."""
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
        faces += [(i * segments + j, i * segments + k, (i + 1) * segments + k, (i + 1) * segments + j)
                  for i in range(rows - 1)]
    return _mesh(name, vertices, faces)


def tube(name: str, path, radii, segments: int = 20):
    """A closed tube along a path (P, 3) that lies in the xz plane, with a radius for each of its points."""
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
    faces = [(i * segments + j, i * segments + (j + 1) % segments,
              (i + 1) * segments + (j + 1) % segments, (i + 1) * segments + j)
             for i in range(n - 1) for j in range(segments)]
    faces += [tuple(range(segments))[::-1], tuple((n - 1) * segments + j for j in range(segments))]
    return _mesh(name, body, faces)


def _union(meshes, scene) -> bpy.types.Mesh:
    """One closed surface from overlapping closed meshes (exact boolean)."""
    objects = [bpy.data.objects.new("part", _finish(m)) for m in meshes]
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


def _from_bmesh(name, build) -> bpy.types.Mesh:
    bm = bmesh.new()
    build(bm)
    mesh = bpy.data.meshes.new(name)
    bm.to_mesh(mesh)
    bm.free()
    return mesh


def _bevelled_box(size, corner, matrix=None):
    def build(bm):
        bmesh.ops.create_cube(bm, size=1.0)
        bmesh.ops.scale(bm, vec=Vector(size), verts=bm.verts)
        bmesh.ops.bevel(bm, geom=list(bm.edges), offset=corner, segments=3, profile=0.5, affect="EDGES")
        if matrix is not None:
            bmesh.ops.transform(bm, matrix=matrix, verts=bm.verts)
    return _from_bmesh("box", build)


def _arc(centre, radius_x, radius_z, start, stop, steps=20):
    t = np.radians(np.linspace(start, stop, steps))
    return np.stack([centre[0] + radius_x * np.cos(t), np.zeros(steps), centre[1] + radius_z * np.sin(t)], 1)


def mug(scene):
    """Mug with a handle, 15 cm high."""
    body = lathe("mug", _rounded([(0, 0), (.055, 0), (.060, .004), (.060, .02), (.060, .14), (.059, .15), (.054, .15),
                                  (.053, .14), (.053, .02), (.050, .012), (0, .012)]))
    handle = tube("handle", _arc((.056, .076), .052, .048, -90, 90), .0105)
    return _union([body, handle], scene)


def bottle(scene):
    """Bottle with a long neck, 36 cm high."""
    return lathe("bottle", _rounded([(0, 0), (.052, 0), (.056, .006), (.056, .03), (.056, .19), (.054, .22),
                                     (.022, .25), (.020, .28), (.020, .335), (.025, .337), (.025, .36),
                                     (.016, .36), (0, .36)]))


def ring(scene):
    """Ring (torus) that stands on its edge, 24 cm high."""
    angle = np.arange(64) * (2 * math.pi / 64)
    small = np.arange(28) * (2 * math.pi / 28)
    big = .085 + .035 * np.cos(small)[None, :]
    points = np.stack([big * np.cos(angle)[:, None], np.broadcast_to(.035 * np.sin(small), (64, 28)),
                       big * np.sin(angle)[:, None] + .1195], -1).reshape(-1, 3)
    faces = [(i * 28 + j, i * 28 + (j + 1) % 28, (i + 1) % 64 * 28 + (j + 1) % 28, (i + 1) % 64 * 28 + j)
             for i in range(64) for j in range(28)]
    return _mesh("ring", points, faces)


def bowl(scene):
    """Bowl, 26 cm wide."""
    return lathe("bowl", _rounded([(0, 0), (.05, 0), (.052, .012), (.075, .02), (.115, .055), (.13, .10), (.123, .102),
                                   (.108, .06), (.07, .03), (0, .025)]))


def books(scene):
    """Stack of three books, 24 cm wide and 13 cm high."""
    stack, z = [], 0.0
    for size, turn in (((.24, .17, .05), 0.0), ((.22, .155, .04), .22), ((.19, .14, .045), -.30)):
        matrix = Matrix.Translation((0, 0, z + size[2] / 2)) @ Matrix.Rotation(turn, 4, "Z")
        stack.append(_bevelled_box(size, .004, matrix))
        z += size[2] - .001
    return _union(stack, scene)


def monkey(scene):
    """Blender's monkey, 24 cm high, smoothed."""
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
    return _stand(mesh, .24)


def teapot(scene):
    """Teapot with spout, handle and lid, 18 cm high."""
    body = lathe("teapot", _rounded([(0, 0), (.06, 0), (.07, .006), (.10, .04), (.105, .085), (.075, .125), (.06, .132),
                                     (.05, .145), (.018, .15), (.012, .158), (.02, .168), (.018, .18), (0, .181)]))
    path = _rounded([(.08, 0, .05), (.12, 0, .055), (.15, 0, .09), (.165, 0, .125), (.185, 0, .135)])
    spout = tube("spout", path, np.linspace(.026, .013, len(path)))
    handle = tube("handle", _arc((-.088, .075), .065, .042, 90, 270), .011)
    return _union([body, spout, handle], scene)


def vase(scene):
    """Vase with twisted lobes, 38 cm high."""
    profile = _rounded([(0, 0), (.055, 0), (.06, .01), (.085, .09), (.09, .16), (.06, .26), (.042, .31), (.055, .365),
                        (.062, .38), (.054, .382), (.036, .32), (.036, .28), (0, .27)])
    return lathe("vase", profile, segments=96, lobes=8, depth=.07, twist=7.0)


def cone(scene):
    """Blunt cone, 26 cm high."""
    return lathe("cone", _rounded([(0, 0), (.095, 0), (.10, .004), (.098, .012), (.015, .25), (.008, .26), (0, .261)]))


def ball(scene):
    """Ball of 18 cm, flattened a little where it stands."""
    mesh = _from_bmesh("ball", lambda bm: bmesh.ops.create_icosphere(bm, subdivisions=5, radius=.09))
    return _stand(mesh, .18)


def die(scene):
    """Cube with round corners, 15 cm."""
    return _bevelled_box((.15, .15, .15), .018, Matrix.Translation((0, 0, .075)))


def pumpkin(scene):
    """Ribbed pumpkin, 16 cm high."""
    profile = _rounded([(0, .012), (.04, 0), (.10, .02), (.115, .07), (.09, .12), (.03, .13), (.016, .135),
                        (.013, .155), (.015, .16), (0, .161)])
    return lathe("pumpkin", profile, segments=96, lobes=9, depth=.06)


def mushroom(scene):
    """Mushroom, 20 cm high."""
    return lathe("mushroom", _rounded([(0, 0), (.045, 0), (.05, .02), (.033, .06), (.035, .10), (.05, .108), (.11, .10),
                                       (.115, .125), (.08, .185), (.03, .20), (0, .20)]))


def gear(scene):
    """Thick gear that lies flat, 24 cm wide."""
    return lathe("gear", [(0, 0), (.10, 0), (.104, .004), (.104, .076), (.10, .08), (.05, .08), (.046, .076),
                          (.044, .05), (0, .05)], segments=120, lobes=10, depth=.09)


MAKERS = {maker.__name__: maker for maker in (
    mug, bottle, ring, bowl, books, monkey, teapot, vase, cone, ball, die, pumpkin, mushroom, gear)}


def make(kind: str, scene) -> bpy.types.Mesh:
    """The mesh of one kind of object (a key of `MAKERS`); `scene` is used as a workbench for booleans."""
    return _finish(MAKERS[kind](scene))


def table(radius: float) -> bpy.types.Mesh:
    """Round table on one foot whose top, of `radius` metres, lies at z = 0."""
    top = _rounded([(.16, -.045), (radius - .02, -.045), (radius, -.038), (radius, -.006), (radius - .006, 0)], 2)
    foot = _rounded([(.30, -.70), (.30, -.68), (.10, -.62), (.06, -.5), (.06, -.15), (.16, -.05)], 2)
    rings = [(r, 0.0) for r in np.linspace(radius - .02, .02, 24)]
    return _finish(lathe("table", [(0, -.70), *foot, *top, *rings, (0, 0)], segments=96), 30)


def backdrop(radius: float) -> bpy.types.Mesh:
    """Closed room of `radius` metres without corners: floor at z = -0.7 (material 0), wall and dome (1).

    Normals point inwards."""
    z, top = -.70, 2.4
    line = _rounded([(radius - .55, z), (radius - .1, z), (radius, z + .15), (radius, .6), (radius, 1.2),
                     (radius * .8, top - .3), (radius * .4, top)], 3)
    floor = [(r, z) for r in np.linspace(.1, radius - .6, 20)]
    mesh = _finish(lathe("backdrop", [(0, z), *floor, *line, (0, top)], segments=128))
    mesh.flip_normals()
    for face in mesh.polygons:
        face.material_index = int(face.center.z > z + .02)
    return mesh


def _stand(mesh, height: float) -> bpy.types.Mesh:
    """Scale to a height in metres and put the lowest point on z = 0, the middle on the axis."""
    points = np.empty(len(mesh.vertices) * 3, np.float32)
    mesh.vertices.foreach_get("co", points)
    low, high = points.reshape(-1, 3).min(0), points.reshape(-1, 3).max(0)
    scale = height / float(high[2] - low[2])
    middle = Vector(((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]))
    mesh.transform(Matrix.Scale(scale, 4) @ Matrix.Translation(-middle))
    return mesh
