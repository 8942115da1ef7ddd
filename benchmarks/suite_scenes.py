"""Synthetic captures of `benchmarks/suite.py`, with exact truth, rendered by the generator of the demo capture.

    .venv-bpy/bin/python benchmarks/suite_scenes.py OUT [NAME ...]

Makes OUT/NAME for each of `SCENES`, or the named ones; what is there already is kept. Each scene is difficult in one
way in which the demo is not.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import itertools
import json
import math
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import bpy
import numpy as np
from mathutils import Matrix, Vector

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import headless

headless.extension()
_DEMO = "objectgs.objectgs_addon.demo"
capture, materials, points, scene, shapes = (
    importlib.import_module(f"{_DEMO}.{name}") for name in ("capture", "materials", "points", "scene", "shapes")
)
events = importlib.import_module("objectgs.backend.shared.events")
srgb = importlib.import_module("objectgs.backend.shared.color.srgb")

VERSION = 1  # Incremented when a scene changes.


class Stage(NamedTuple):
    """What is rendered.

    Attributes:
        built: the scene.
        objects: objects with IDs 1..N.
        views: cameras in the order of the model.
        develop: changes the picture of a view as a camera might.
        prepare: changes the settings of Cycles for pictures.
        target: wanted number of points.
    """

    built: bpy.types.Scene
    objects: list[Any]
    views: list[Any]
    develop: Callable[[np.ndarray, int], np.ndarray] = lambda image, _index: image
    prepare: Callable[[bpy.types.Scene], None] = lambda _scene: None
    target: int = points.TARGET


def room(seed: int) -> Stage:
    """A rectangular room from inside; the objects stand against its walls."""
    built, objs = things(("mug", "bottle", "books", "monkey", "teapot", "vase", "pumpkin", "gear"), seed)
    half = np.array([1.9, 1.5])
    around = [(-1.2, 1.22), (0.1, 1.25), (1.3, 1.2), (1.6, 0.2), (1.35, -1.2), (0.0, -1.22), (-1.3, -1.2), (-1.62, 0.1)]
    rng = scene.rng_for(seed, 11)
    for obj, (x, y) in zip(objs, around, strict=True):
        place(obj, (x, y, -0.7), float(rng.uniform(0, 2 * math.pi)), 2.2)
    add(built, objs, "room", _box(half, -0.7, 1.3), [materials.floor, materials.wall], seed)
    scene.pass_light(objs[-1])
    views = []
    for i in range(60):
        angle = 2 * math.pi * i / 30 + rng.normal(0, 0.05)
        away = 0.55 + 0.1 * rng.random()
        center = np.array([-away * math.cos(angle) * 1.2, -away * math.sin(angle), (0.15, 0.55)[i // 30]])
        target = np.array([1.7 * math.cos(angle), 1.4 * math.sin(angle), -0.35 + rng.normal(0, 0.05)])
        views.append(scene.look_at(i, center, target))
    return Stage(built, objs, views)


def yard(seed: int) -> Stage:
    """Objects on the ground before an open sky, which is in no mask and has no points."""
    built, objs = things(("bottle", "vase", "ball", "pumpkin", "cone", "die", "mushroom"), seed)
    rng = scene.rng_for(seed, 11)
    for obj, (x, y) in zip(objs, ring(len(objs), 0.5, rng), strict=True):
        place(obj, (x, y, 0.0), float(rng.uniform(0, 2 * math.pi)), 1.4)
    ground = shapes.lathe(
        "ground", [(0, -0.02), (4.0, -0.02), (4.0, 0.0), *((r, 0.0) for r in (3.0, 2, 1, 0.4)), (0, 0)]
    )
    add(built, objs, "ground", shapes.finish(ground), [materials.table], seed)
    _sky(built)
    views = []
    for i in range(48):
        angle = 2 * math.pi * i / 24 + rng.normal(0, 0.03)
        radius, height = ((1.6, 0.35), (1.9, 0.8))[i // 24]
        center = np.array([radius * math.cos(angle), radius * math.sin(angle), height])
        views.append(scene.look_at(i, center, np.array([0, 0, 0.28]) + rng.normal(0, 0.02, 3)))
    return Stage(built, objs, views)


def few(seed: int) -> Stage:
    """The demo's scene from 12 views only."""
    built, objs = scene.build(6, seed)
    return Stage(built, objs, scene.cameras(12, seed), target=4_000)


def plain(seed: int) -> Stage:
    """The demo's scene in a room and on a table without texture."""
    built, objs = scene.build(6, seed)
    for obj, colors in ((objs[-1], ((0.20, 0.19, 0.18), (0.55, 0.58, 0.60))), (objs[-2], ((0.62, 0.60, 0.56),))):
        for slot, color in enumerate(colors):
            glows = obj is objs[-1]
            obj.object.data.materials[slot] = _one_color(color, glows)
    return Stage(built, objs, scene.cameras(48, seed), target=6_000)


def thin(seed: int) -> Stage:
    """A chair, a plant and a fence on the table."""
    built, objs = things(("mug", "ball"), seed)
    rng = scene.rng_for(seed, 11)
    place(objs[0], (0.33, -0.18, 0.0), 0.4, 1.0)
    place(objs[1], (-0.30, -0.28, 0.0), 1.0, 0.8)
    for name, mesh, where, kind in (
        ("chair", _chair(), (-0.12, 0.1, 0.0), "die"),
        ("plant", _plant(rng), (0.28, 0.2, 0.0), "bottle"),
        ("fence", _fence(), (0.0, -0.42, 0.0), "cone"),
    ):
        add(built, objs, name, mesh, [lambda rng, kind=kind: materials.material(kind, rng)], seed)
        objs[-1].object.location = where
    add(built, objs, "table", shapes.table(0.66), [materials.table], seed)
    add(built, objs, "backdrop", shapes.backdrop(2.6), [materials.floor, materials.wall], seed)
    scene.pass_light(objs[-1])
    return Stage(built, objs, scene.cameras(48, seed))


def gloss(seed: int) -> Stage:
    """Polished, metal and glass objects."""
    built, objs = scene.build(7, seed)
    for obj, (roughness, metal, glass) in zip(
        objs, ((0.08, 0, 0), (0.1, 0, 0.8), (0.15, 1, 0), (0.05, 0, 0), (0.3, 0, 0), (0.2, 1, 0), (0.1, 0, 0)),
        strict=False,
    ):  # fmt: skip
        shader = next(n for n in obj.object.data.materials[0].node_tree.nodes if n.type == "BSDF_PRINCIPLED")
        for name, value in (
            ("Roughness", roughness), ("Specular IOR Level", 0.6), ("Metallic", metal), ("Transmission Weight", glass)
        ):  # fmt: skip
            shader.inputs[name].default_value = value

    def bounces(built: bpy.types.Scene) -> None:
        built.cycles.max_bounces, built.cycles.glossy_bounces, built.cycles.transmission_bounces = 6, 3, 4

    objs[-1].object.visible_glossy = True
    return Stage(built, objs, scene.cameras(48, seed), prepare=bounces)


def many(seed: int) -> Stage:
    """60 small objects."""
    built, objs = scene.build(60, seed)
    return Stage(built, objs, scene.cameras(60, seed))


def exposure(seed: int) -> Stage:
    """Exposure and white balance at random in photos without an order."""
    built, objs = scene.build(7, seed)
    rng = scene.rng_for(seed, 11)
    views = _shuffled(scene.cameras(40, seed), rng)
    gains = 2.0 ** rng.uniform(-0.8, 0.5, (len(views), 1)) * rng.uniform(0.88, 1.12, (len(views), 3))

    def develop(image: np.ndarray, index: int) -> np.ndarray:
        return _encoded(srgb.decode(image / 255.0) * gains[index])

    return Stage(built, objs, views, develop)


def blur(seed: int) -> Stage:
    """Shaken and noisy photos."""
    built, objs = scene.build(7, seed)
    views = scene.cameras(48, seed)
    rng = scene.rng_for(seed, 11)
    shakes = rng.normal(0, 1.3, (len(views), 2))

    def develop(image: np.ndarray, index: int) -> np.ndarray:
        linear = srgb.decode(image / 255.0)
        steps = np.linspace(-1, 1, 9)
        moved = np.mean([_shifted(linear, *(step * shakes[index])) for step in steps], 0)
        noise = scene.rng_for(seed, 12, index).normal(0, 1, moved.shape)
        return _encoded(moved + noise * np.sqrt(1.5e-3 * np.maximum(moved, 0) + 2e-5))

    return Stage(built, objs, views, develop)


def sparse(seed: int) -> Stage:
    """23 photos from all sides, without an order, with few points."""
    built, objs = scene.build(8, seed)
    return Stage(built, objs, _shuffled(scene.cameras(23, seed), scene.rng_for(seed, 11)), target=2_000)


def ample(seed: int) -> Stage:
    """The scene of `sparse`, which is made just before, from 60 photos with many points."""
    built, objs = scene.build(8, seed - 1)
    return Stage(built, objs, scene.cameras(60, seed - 1), target=15_000)


SCENES = {make.__name__: make for make in (room, yard, few, plain, thin, gloss, many, exposure, blur, sparse, ample)}
"""In the order of their seeds: new scenes are appended."""


def things(kinds: tuple[str, ...], seed: int) -> tuple[bpy.types.Scene, list[Any]]:
    """Return a new lit scene with an object of each kind at its origin."""
    built = bpy.data.scenes.new("suite")
    objs: list[Any] = []
    for kind in kinds:
        add(built, objs, kind, shapes.make(kind, built), [lambda rng, kind=kind: materials.material(kind, rng)], seed)
    scene.light(built)
    return built, objs


def add(built: bpy.types.Scene, objs: list[Any], name: str, mesh: bpy.types.Mesh, looks: list[Any], seed: int) -> None:
    """Add an object with the next ID, with materials made by `looks`."""
    for i, look in enumerate(looks):
        mesh.materials.append(look(scene.rng_for(seed, 10, len(objs), i)))
    obj = scene.DemoObject(len(objs) + 1, name, bpy.data.objects.new(name, mesh))
    obj.object.pass_index = obj.id
    built.collection.objects.link(obj.object)
    objs.append(obj)


def place(obj: Any, where: tuple[float, float, float], turn: float, scale: float) -> None:
    obj.object.matrix_world = Matrix.Translation(where) @ Matrix.Rotation(turn, 4, "Z") @ Matrix.Scale(scale, 4)


def ring(count: int, radius: float, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Return places on a circle and one in its middle."""
    angles = [2 * math.pi * i / (count - 1) + float(rng.normal(0, 0.1)) for i in range(count - 1)]
    return [(0.0, 0.0), *((radius * math.cos(angle), radius * math.sin(angle)) for angle in angles)]


def _box(half: np.ndarray, low: float, high: float, cells: int = 16) -> bpy.types.Mesh:
    """Return a box seen from inside; its floor has material 0, walls and ceiling material 1."""
    import bmesh

    bm = bmesh.new()
    bmesh.ops.create_cube(bm, size=2.0)
    bmesh.ops.scale(bm, vec=(*half, (high - low) / 2), verts=bm.verts)
    bmesh.ops.translate(bm, vec=(0, 0, (high + low) / 2), verts=bm.verts)
    bmesh.ops.subdivide_edges(bm, edges=bm.edges, cuts=cells - 1, use_grid_fill=True)
    bmesh.ops.reverse_faces(bm, faces=bm.faces)
    mesh = bpy.data.meshes.new("room")
    bm.to_mesh(mesh)
    bm.free()
    for face in mesh.polygons:
        face.material_index = int(face.center.z > low + 0.01)
    return mesh


def _sky(built: bpy.types.Scene) -> None:
    """Replace the even light of the world by a sky that is brighter toward the horizon, with soft clouds."""
    tree = built.world.node_tree
    n = materials.Nodes.__new__(materials.Nodes)
    n.tree = tree
    direction = n.add("TexCoord").outputs["Generated"]
    height = n.add("SeparateXYZ", {0: direction}).outputs[2]
    blue = n.ramp(height, [(0.62, 0.75, 0.9, 1), (0.2, 0.4, 0.8, 1)], soft=True, stops=[0.0, 0.7])
    clouds = n.ramp(n.noise(direction, 3.0, 3.0), [(0, 0, 0, 1), (1, 1, 1, 1)], soft=True, stops=[0.5, 0.7])
    color = n.mix(clouds, blue, (0.95, 0.95, 0.97, 1))
    background = next(node for node in tree.nodes if node.type == "BACKGROUND")
    tree.links.new(color, background.inputs[0])
    background.inputs[1].default_value = 0.9


def _one_color(color: tuple[float, float, float], glows: bool) -> bpy.types.Material:
    n = materials.Nodes("plain")
    return n.glow((*color, 1.0)) if glows else n.finish((*color, 1.0))


def _joined(parts: list[bpy.types.Mesh], name: str) -> bpy.types.Mesh:
    """Return one mesh of several, which may overlap."""
    vertices, faces = [], []
    for part in parts:
        first = len(vertices)
        vertices += [vertex.co.copy() for vertex in part.vertices]
        faces += [[first + index for index in face.vertices] for face in part.polygons]
        bpy.data.meshes.remove(part)
    return shapes.finish(shapes.from_faces(name, vertices, faces))


def _rod(start: tuple[float, float, float], end: tuple[float, float, float], radius: float) -> bpy.types.Mesh:
    """Return a closed tube between two points."""
    along = np.array(end, float) - start
    mesh = shapes.tube("rod", [(0, 0, z) for z in np.linspace(0, float(np.linalg.norm(along)), 8)], radius, 10)
    turn = Vector((0, 0, 1)).rotation_difference(Vector(along.tolist())).to_matrix()
    mesh.transform(Matrix.Translation(start) @ turn.to_4x4())
    return mesh


def _chair() -> bpy.types.Mesh:
    """Return a chair of rods, 40 cm high."""
    x = y = 0.09
    seat, top = 0.2, 0.4
    parts = [
        _rod((sx * x, sy * y, 0), (sx * x, sy * y, seat if sy < 0 else top), 0.008) for sx in (-1, 1) for sy in (-1, 1)
    ]
    parts += [_rod((-x, sy, z), (x, sy, z), 0.006) for sy, z in ((-y, seat), (y, seat), (y, top), (y, 0.3), (-y, 0.08))]
    parts += [_rod((-x + 0.03 * i, -y, seat), (-x + 0.03 * i, y, seat), 0.006) for i in range(7)]
    return _joined(parts, "chair")


def _plant(rng: np.random.Generator) -> bpy.types.Mesh:
    """Return stems with narrow leaves, 35 cm high."""
    parts = []
    for i in range(9):
        angle, lean = 2 * math.pi * i / 9, rng.uniform(0.05, 0.14)
        out = np.array([math.cos(angle), math.sin(angle)])
        line = [(*(out * lean * (h / 0.35) ** 2), h) for h in np.linspace(0, rng.uniform(0.22, 0.35), 4)]
        parts += [_rod(a, b, 0.004) for a, b in itertools.pairwise(line)]
        side = np.array([-out[1], out[0]])
        for a, b in itertools.pairwise(line[1:]):
            for sign in (-1, 1):
                tip = np.array(b) + np.array([*(sign * 0.05 * side + 0.02 * out), 0.03])
                parts.append(_leaf(np.array(a), tip))
    return _joined(parts, "plant")


def _leaf(start: np.ndarray, tip: np.ndarray) -> bpy.types.Mesh:
    """Return a closed, thin, pointed leaf."""
    along = tip - start
    across = np.cross(along, [0, 0, 1.0])
    across *= 0.012 / np.linalg.norm(across)
    up = np.cross(across, along)
    up *= 0.0015 / np.linalg.norm(up)
    middle = start + 0.5 * along
    vertices = [start, middle + across, tip, middle - across, middle + up, middle - up]
    faces = [(0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4), (1, 0, 5), (2, 1, 5), (3, 2, 5), (0, 3, 5)]
    return shapes.from_faces("leaf", vertices, faces)


def _shuffled(views: list[Any], rng: np.random.Generator) -> list[Any]:
    """Return views whose names are in another order than they."""
    names = [view.name for view in views]
    return [
        dataclasses.replace(view, name=names[i]) for view, i in zip(views, rng.permutation(len(views)), strict=True)
    ]


def _fence() -> bpy.types.Mesh:
    """Return a fence of slats, 50 cm wide."""
    parts = [_rod((x, 0, 0), (x, 0, 0.16), 0.007) for x in np.linspace(-0.25, 0.25, 13)]
    parts += [_rod((-0.26, 0, z), (0.26, 0, z), 0.006) for z in (0.04, 0.13)]
    return _joined(parts, "fence")


def _encoded(linear: np.ndarray) -> np.ndarray:
    return np.round(srgb.encode(np.clip(linear, 0, 1)) * 255).astype(np.uint8)


def _shifted(image: np.ndarray, right: float, down: float) -> np.ndarray:
    """Return an image (H, W, 3) moved by fractions of pixels, with repeated borders."""
    height, width = image.shape[:2]
    rows, columns = np.clip(np.arange(height) - down, 0, height - 1), np.clip(np.arange(width) - right, 0, width - 1)
    i, j = np.minimum(rows.astype(int), height - 2), np.minimum(columns.astype(int), width - 2)
    v, u = (rows - i)[:, None, None], (columns - j)[None, :, None]
    upper = (1 - u) * image[i][:, j] + u * image[i][:, j + 1]
    lower = (1 - u) * image[i + 1][:, j] + u * image[i + 1][:, j + 1]
    return (1 - v) * upper + v * lower


def make(name: str, out: Path, samples: int) -> Path:
    """Make one capture of the suite."""
    return make_stage(SCENES[name], out / name, 100 + list(SCENES).index(name), samples)


def make_stage(
    build: Callable[[int], Stage], folder: Path, seed: int, samples: int, size: tuple[int, int] = (320, 240)
) -> Path:
    """Make a capture of a stage, or keep it if it is of this version; an unfinished one is made again."""
    settings = capture.Settings(seed=seed, samples=samples, width=size[0], height=size[1])
    record = {"suite": VERSION, "scene": build.__name__, "samples": samples}
    stored = folder / "truth" / "settings.json"
    if stored.is_file() and json.loads(stored.read_text(encoding="utf-8")) == record:
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    stage = build(seed)
    stage.built.view_layers[0].update()
    folder.mkdir(parents=True)
    reporter = events.StagedReporter(events.Reporter())
    capture.begin(reporter, len(stage.views))
    found = capture.write(
        folder, stage.built, stage.objects, stage.views, settings, reporter,
        develop=stage.develop, prepare=stage.prepare, target=stage.target,
    )  # fmt: skip
    stored.write_text(json.dumps(record), encoding="utf-8")
    print(f"{folder}: {len(stage.views)} views, {len(stage.objects)} objects, {found} points", flush=True)
    return folder


def main() -> None:
    """Make the captures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--samples", type=int, default=20)
    options = parser.parse_args()
    unknown = set(options.names) - set(SCENES)
    if unknown:
        parser.error(f"unknown: {', '.join(sorted(unknown))}; there are {', '.join(SCENES)}")
    for name in options.names or SCENES:
        make(name, options.out, options.samples)


if __name__ == "__main__":
    main()
