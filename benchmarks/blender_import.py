# SPDX-License-Identifier: GPL-3.0-or-later
"""Time that Blender is blocked while it shows a result: many splats in few objects, many objects, and their meshes.

Runs inside Blender or in a Python with the bpy wheel. Times are medians over repeats, each in a new file. `show` is
`show_result`, from the files to the collections; `update` is the first depsgraph evaluation after it; `again` shows the
same result once more. `meshes` adds a small mesh to each object that is already shown; `switch` shows splats instead of
meshes.

    blender -b -P benchmarks/blender_import.py -- [--json] [--splats 1000000] [--objects 1000] [--repeats 3]
"""

import argparse
import importlib.util
import json
import statistics
import sys
import tempfile
import time
from pathlib import Path

import bpy
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
DEGREE_1 = 9


def extension():
    """Load the repository root as package `objectgs` and return the modules that this benchmark uses."""
    if "objectgs" not in sys.modules:
        spec = importlib.util.spec_from_file_location(
            "objectgs", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)]
        )
        module = importlib.util.module_from_spec(spec)
        sys.modules["objectgs"] = module
        spec.loader.exec_module(module)
    names = ("objectgs_addon.scene", "backend.shared.formats.ply", "backend.shared.formats.mesh_ply")
    return tuple(importlib.import_module(f"objectgs.{name}") for name in names)


def write_result(folder: Path, splats: int, objects: int, write_vertices) -> None:
    """Write a reconstruction: random splats of SH degree 1, one anchor per ten splats, 1,000 points and a camera."""
    rng = np.random.default_rng(0)
    names = [*"xyz", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(DEGREE_1))]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    table = np.empty(splats, [*((name, "<f4") for name in names), ("object_id", "<u4")])
    for name in names:
        table[name] = rng.normal(size=splats)
    for axis in range(3):
        table[f"scale_{axis}"] = np.log(0.01)
    table["object_id"] = rng.integers(1, objects + 1, splats)
    write_vertices(folder / "splats.ply", table)
    anchors = np.zeros(
        splats // 10,
        [*((name, "<f4") for name in "xyz"), ("object_id", "<u4"), *((f"scale_{i}", "<f4") for i in range(3)),
         ("opacity", "<f4"), ("splats", "<u4")],
    )  # fmt: skip
    for name in ("x", "y", "z", "object_id"):
        anchors[name] = table[name][: len(anchors)]
    write_vertices(folder / "anchors.ply", anchors)
    points = np.zeros(
        1000,
        [*((name, "<f8") for name in "xyz"), *((name, "u1") for name in ("red", "green", "blue")),
         ("object_id", "<u4"), ("margin", "<f4"), ("votes", "<u4")],
    )  # fmt: skip
    write_vertices(folder / "points.ply", points)
    entries = [
        {"id": i, "name": f"thing {i}", "color": [200, 100, i % 256], "points": 1} for i in range(1, objects + 1)
    ]
    (folder / "objects.json").write_text(json.dumps({"objects": entries, "edits": {}}))
    camera = {"name": "a.png", "image": "a.png", "mask": None, "width": 640, "height": 480, "held_out": False,
              "K": [[500, 0, 320], [0, 500, 240], [0, 0, 1]], "viewmat": np.eye(4).tolist()}  # fmt: skip
    upright = {"rotation": np.eye(3).tolist(), "translation": [0, 0, 0]}
    content = {"capture": str(folder), "origin": [0, 0, 0], "upright": upright, "cameras": [camera]}
    (folder / "cameras.json").write_text(json.dumps(content))


def write_meshes(folder: Path, objects: int, mesh_file) -> None:
    """Write meshes/ with a closed grid of 16 x 16 vertices (512 faces) and a small texture for each object."""
    place = folder / "meshes"
    place.mkdir()
    image = bpy.data.images.new("texture", 64, 64)
    image.filepath_raw, image.file_format = str(place / "texture.png"), "PNG"
    image.save()
    image = (place / "texture.png").read_bytes()
    u, v = (index.reshape(-1) for index in np.mgrid[0:16, 0:16])
    here, right, above, across_it = (
        (u + i) % 16 * 16 + (v + j) % 16 for i, j in ((0, 0), (1, 0), (0, 1), (1, 1))
    )  # fmt: skip
    faces = np.concatenate([np.stack([here, right, across_it], 1), np.stack([here, across_it, above], 1)])
    across = np.stack([np.cos(u / 8 * np.pi), np.sin(u / 8 * np.pi), 0 * u], 1)
    vertices = across * (1 + 0.4 * np.cos(v / 8 * np.pi))[:, None]
    vertices[:, 2] = 0.4 * np.sin(v / 8 * np.pi)
    entries = {}
    for i in range(1, objects + 1):
        (place / f"{i}.png").write_bytes(image)
        mesh_file.write_mesh(place / f"{i}.ply", mesh_file.Mesh(
            vertices + i, across.astype(np.float32), np.full((256, 3), 100, np.uint8), faces.astype(np.int32),
            np.zeros((512, 3, 2), np.float32), np.zeros(512, bool), f"{i}.png"))  # fmt: skip
        entries[i] = {"name": f"thing {i}", "ids": [i], "file": f"{i}.ply", "texture": f"{i}.png", "trained_steps": 0}
    (place / "meshes.json").write_text(json.dumps({"trained_steps": 0, "meshes": entries}))


def measure(splats: int, objects: int, repeats: int) -> dict:
    """Measure the median seconds of each operation."""
    scene, ply, mesh_file = extension()
    times: dict[str, list[float]] = {name: [] for name in ("show", "update", "again", "meshes", "switch")}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write_result(folder, splats, objects, ply.write_vertices)
        write_meshes(folder, objects, mesh_file)
        meshes, away = folder / "meshes", folder / "away"
        for _ in range(repeats):
            meshes.rename(away)
            bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
            owner = bpy.context.scene
            root = scene.show_capture(owner, folder)
            bpy.context.view_layer.update()
            for name in times:
                if name == "meshes":
                    away.rename(meshes)
                start = time.perf_counter()
                if name == "update":
                    bpy.context.view_layer.update()
                elif name == "meshes":
                    scene.show_meshes(root, folder)
                elif name == "switch":
                    scene.show_kinds(root, "splats")
                else:
                    scene.show_result(root, folder)
                times[name].append(time.perf_counter() - start)
    return {"splats": splats, "objects": objects, **{k: round(statistics.median(v), 2) for k, v in times.items()}}


def main(arguments: list[str]) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="blender_import.py", description=__doc__.split("\n", 1)[0])
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line")
    parser.add_argument("--splats", type=int, default=1_000_000, help="in ten objects (default 1000000)")
    parser.add_argument("--objects", type=int, default=1_000, help="of 100 splats each (default 1000)")
    parser.add_argument("--repeats", type=int, default=3, help="the median of so many counts (default 3)")
    options = parser.parse_args(arguments)
    found = {
        "blender": bpy.app.version_string,
        "many_splats": measure(options.splats, 10, options.repeats),
        "many_objects": measure(100 * options.objects, options.objects, options.repeats),
    }
    for case in ("many_splats", "many_objects"):
        row = found[case]
        print(f"{row['splats']:>9,} splats in {row['objects']:>5,} objects: shown in {row['show']:.2f} s, "
              f"evaluated in {row['update']:.2f} s, shown again in {row['again']:.2f} s; "
              f"their meshes in {row['meshes']:.2f} s, splats again in {row['switch']:.2f} s")  # fmt: skip
    if options.json:
        print(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:])
