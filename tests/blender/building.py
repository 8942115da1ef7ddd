# SPDX-License-Identifier: GPL-3.0-or-later
"""Hand-made reconstruction folders, in which all values of cameras, points, splats and meshes are known."""

import json
import math
import struct
import zlib
from pathlib import Path

import numpy as np
from objectgs.backend.shared.formats import points_ply
from objectgs.backend.shared.formats.anchors_ply import AnchorTable, write_anchor_tables
from objectgs.backend.shared.formats.mesh_ply import Mesh, write_mesh
from objectgs.backend.shared.formats.ply import write_vertices
from objectgs.backend.shared.formats.points_ply import LabeledPoints
from objectgs.backend.shared.formats.splat_ply import NORMALS, OBJECT_ID, property_names, splat_dtype

HUGE = 0xFFFFFFF0
OBJECTS = {1: "mug", 2: "can", HUGE: "box"}
K = np.array([[500.0, 0.0, 310.0], [0.0, 500.0, 250.5], [0.0, 0.0, 1.0]])


def look_at(camera_center, target=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the world-to-camera matrix (4, 4) of an OpenCV camera at `camera_center` that looks at `target`."""
    camera_center = np.asarray(camera_center, float)
    forward = np.asarray(target, float) - camera_center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = rotation, -rotation @ camera_center
    return view


def write_cameras(folder: Path, views, intrinsics=K, size=(640, 480), origin=(0.0, 0.0, 0.0), upright=None) -> None:
    upright = np.eye(4) if upright is None else upright
    cameras = [
        {
            "name": f"{i:03}.png",
            "image": f"images/{i:03}.png",
            "mask": None,
            "width": size[0],
            "height": size[1],
            "K": np.asarray(intrinsics).tolist(),
            "viewmat": view.tolist(),
            "held_out": i % 8 == 0,
        }
        for i, view in enumerate(views)
    ]
    (folder / "images").mkdir(exist_ok=True)
    for camera in cameras:
        (folder / camera["image"]).write_bytes(b"not read until it is drawn")
    (folder / "cameras.json").write_text(
        json.dumps(
            {
                "capture": str(folder),
                "origin": list(origin),
                "cameras": cameras,
                "upright": {"rotation": upright[:3, :3].tolist(), "translation": upright[:3, 3].tolist()},
            }
        )
    )


def write_points(folder: Path, xyz, ids) -> None:
    count = len(xyz)
    rgb = np.tile(np.array([200, 0, 0], np.uint8), (count, 1))
    points = LabeledPoints(np.asarray(xyz), rgb, np.asarray(ids), np.full(count, 0.5), np.zeros(count, int))
    points_ply.write_points(folder / "points.ply", points)


def write_objects(folder: Path, objects=OBJECTS) -> None:
    entries = [
        {"id": object_id, "name": name, "color": [10, 20, 30 + i], "points": 1}
        for i, (object_id, name) in enumerate(objects.items())
    ]
    (folder / "objects.json").write_text(json.dumps({"objects": entries, "edits": {}}))


def splat_table(ids, degree: int = 1, seed: int = 0) -> np.ndarray:
    names = [name for name in property_names(degree) if name not in (*NORMALS, OBJECT_ID)]
    table = np.zeros(len(ids), splat_dtype([*names, OBJECT_ID]))
    rng = np.random.default_rng(seed)
    for name in names:
        table[name] = rng.normal(size=len(ids))
    table["object_id"] = ids
    return table


def write_anchors(folder: Path, ids) -> None:
    count = len(ids)
    positions = np.tile([3.0, 0.0, 0.0], (count, 1))
    anchors = AnchorTable(positions, ids, np.zeros((count, 3)), np.full(count, 0.25), np.full(count, 7))
    write_anchor_tables(folder / "anchors.ply", count, [anchors], "f4")


def write_folder(place: Path) -> Path:
    """Write 8 cameras around the origin, 30 points, and 40 splats of 3 objects and of no object."""
    place.mkdir()
    views = [look_at((3 * math.cos(a), 3 * math.sin(a), 1.0)) for a in np.linspace(0, 2 * math.pi, 8, endpoint=False)]
    write_cameras(place, views)
    rng = np.random.default_rng(1)
    write_points(place, rng.normal(size=(30, 3)), np.resize([0, *OBJECTS], 30))
    write_objects(place)
    write_vertices(place / "splats.ply", splat_table(np.resize([0, *OBJECTS], 40)))
    write_anchors(place, np.resize([0, *OBJECTS], 8))
    return place


def tetrahedron(center=(0.0, 0.0, 0.0), size: float = 1.0, texture: str = "") -> Mesh:
    """Return a closed mesh of 4 vertices and 4 faces with distinct values; the last face is unobserved."""
    corners = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], float)
    faces = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)], np.int32)
    normals = corners - 0.25
    return Mesh(
        vertices=np.asarray(center) + size * corners,
        normals=(normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32),
        colors=(10 + 20 * np.arange(12)).reshape(4, 3).astype(np.uint8),
        faces=faces,
        uvs=(np.arange(24) / 24.0).reshape(4, 3, 2).astype(np.float32),
        unobserved=np.array([False, False, False, True]),
        texture=texture,
    )


def write_png(path: Path, rgb, size: int = 4) -> None:
    """Write a PNG of one color."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    row = b"\0" + bytes(rgb) * size
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", size, size, 8, 2, 0, 0, 0))
        + chunk(b"IDAT", zlib.compress(row * size))
        + chunk(b"IEND", b"")
    )


def write_meshes(folder: Path, meshes: dict, ids: dict | None = None, rgb=(200, 100, 50)) -> None:
    """Write meshes/ like the backend. meshes: key -> Mesh, or the reason why there is none; ids: key -> object IDs."""
    place = folder / "meshes"
    place.mkdir(exist_ok=True)
    entries = {}
    for key, mesh in meshes.items():
        entry = {"name": f"name of {key}", "trained_steps": 7}
        entry["ids"] = (ids or {}).get(key, [int(key)] if key.isdecimal() else None)
        if isinstance(mesh, str):
            entries[key] = {**entry, "why": mesh}
            continue
        mesh.texture = f"{key}.png"
        write_mesh(place / f"{key}.ply", mesh)
        write_png(place / f"{key}.png", rgb)
        entries[key] = {
            **entry,
            "file": f"{key}.ply",
            "texture": f"{key}.png",
            "vertices": len(mesh.vertices),
            "faces": len(mesh.faces),
            "watertight": True,
            "unobserved": 0.25,
            "seconds": 0.1,
        }
    (place / "meshes.json").write_text(json.dumps({"trained_steps": 7, "meshes": entries}))
