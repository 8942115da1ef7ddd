"""Writers of the files in which other programs store cameras and points, for a scene of `write_capture`."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
CHUNK = np.eye(4)
CHUNK[:3, :3], CHUNK[:3, 3] = 2.5 * Rotation.from_euler("xyz", [0.3, -0.8, 0.4]).as_matrix(), (4.0, -3.0, 2.0)
"""A similarity, as Metashape's from a chunk to the world."""


def drop_colmap(scene) -> None:
    """Remove the COLMAP model of a scene."""
    shutil.rmtree(scene.folder / "sparse")


def write_ply(path: Path, xyz, rgb, text: bool = False) -> None:
    """Write points as binary PLY with doubles, or as ASCII PLY."""
    kind = "ascii" if text else "binary_little_endian"
    lines = [f"ply\nformat {kind} 1.0\nelement vertex {len(xyz)}", *(f"property double {axis}" for axis in "xyz")]
    lines += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    head = "\n".join([*lines, "end_header\n"]).encode()
    if text:
        rows = [" ".join([*(repr(float(v)) for v in p), *map(str, c)]) for p, c in zip(xyz, rgb)]
        path.write_bytes(head + ("\n".join(rows) + "\n").encode())
        return
    table = np.zeros(len(xyz), [("xyz", "<f8", 3), ("rgb", "u1", 3)])
    table["xyz"], table["rgb"] = xyz, rgb
    path.write_bytes(head + table.tobytes())


def opencv_of(scene) -> dict[str, float]:
    """Return the scene's OPENCV or PINHOLE camera by nerfstudio's names."""
    _, width, height, params = scene.camera
    names = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
    return {**dict(zip(names, map(float, params))), "w": width, "h": height}


def write_transforms(scene, edit=lambda content: None, points: str | None = "sparse_pc.ply", applied=None) -> Path:
    """Write transforms.json; `edit` changes its content, `applied` (4, 4) is an applied transform."""
    applied = np.eye(4) if applied is None else applied
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": (applied @ np.linalg.inv(view) @ FLIP).tolist()}
        for name, view in zip(scene.names, scene.viewmats)
    ]
    content = {**opencv_of(scene), "camera_model": "OPENCV", "frames": frames}
    if points:
        content["ply_file_path"] = points
        write_ply(scene.folder / points, scene.xyz @ applied[:3, :3].T + applied[:3, 3], scene.rgb, text=True)
    if (applied != np.eye(4)).any():
        content["applied_transform"] = applied[:3].tolist()
    edit(content)
    path = scene.folder / "transforms.json"
    path.write_text(json.dumps(content))
    return path


def write_bundler(scene, name: str = "bundle.out", listed: str = "list.txt", points: bool = True) -> Path:
    """Write a Bundler file of a scene with a centered SIMPLE_RADIAL or RADIAL camera, and its list."""
    _, width, height, params = scene.camera
    k1, k2 = (*params[3:], 0.0, 0.0)[:2]
    lines = ["# Bundle file v0.3", f"{len(scene.names)} {len(scene.xyz) if points else 0}"]
    for view in scene.viewmats:
        flipped = FLIP @ view
        lines.append(f"{params[0]!r} {k1!r} {k2!r}")
        lines += [" ".join(repr(float(v)) for v in row) for row in [*flipped[:3, :3], flipped[:3, 3]]]
    for point in range(len(scene.xyz) if points else 0):
        lines += [" ".join(repr(float(v)) for v in scene.xyz[point]), " ".join(map(str, scene.rgb[point]))]
        views = []
        for view, (seen, pixels) in enumerate(zip(scene.seen, scene.pixels)):
            for key in np.flatnonzero(seen == point):
                x, y = pixels[key]
                views.append(f"{view} {key} {float(x - width / 2)!r} {float(height / 2 - y)!r}")
        lines.append(" ".join([str(len(views)), *views]))
    path = scene.folder / name
    path.write_text("\n".join(lines) + "\n")
    (scene.folder / listed).write_text("".join(f"./images/{name}\n" for name in scene.names), encoding="utf-8")
    return path


def write_realityscan(scene, name: str = "cameras.csv", points: str | None = "cloud.ply") -> Path:
    """Write RealityScan's CSV of a scene with an OPENCV camera with equal focal lengths."""
    lens = opencv_of(scene)
    side = max(lens["w"], lens["h"])
    lines = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for image, view in zip(scene.names, scene.viewmats):
        pose = np.linalg.inv(view) @ FLIP
        turn = pose[:3, :3]
        # The inverse of rotations about y by the roll, about x by the pitch and about z by minus the heading.
        pitch, roll = np.arcsin(turn[2, 1]), np.arctan2(-turn[2, 0], turn[2, 2])
        heading = -np.arctan2(-turn[0, 1], turn[1, 1])
        numbers = [*pose[:3, 3], *np.degrees([heading, pitch, roll]), lens["fl_x"] * 36 / side]
        numbers += [(lens["cx"] - lens["w"] / 2) / side, (lens["cy"] - lens["h"] / 2) / side]
        numbers += [lens.get("k1", 0), lens.get("k2", 0), 0, 0, lens.get("p1", 0), lens.get("p2", 0)]
        lines.append(",".join([image, *(repr(float(number)) for number in numbers)]))
    if points:
        write_ply(scene.folder / points, scene.xyz, scene.rgb)
    path = scene.folder / name
    path.write_text("\r\n".join(lines) + "\r\n", encoding="utf-8-sig")
    return path


def write_metashape(scene, kind: str = "frame", newer: bool = False, chunk=CHUNK) -> Path:
    """Write Metashape's XML of a scene with an OPENCV or OPENCV_FISHEYE camera, in a chunk that `chunk` places.

    `newer` files have the transform in a component.
    """
    _, width, height, params = scene.camera
    names = ("k1", "k2", "p2", "p1") if kind == "frame" else ("k1", "k2", "k3", "k4")
    values = {"f": params[1], "b1": params[0] - params[1], "cx": params[2] - width / 2, "cy": params[3] - height / 2}
    values.update(zip(names, params[4:]))
    calibration = "".join(f"<{key}>{float(value)!r}</{key}>" for key, value in values.items())
    scale = np.cbrt(np.linalg.det(chunk[:3, :3]))
    transform = (
        f"<transform><rotation>{_text(chunk[:3, :3] / scale)}</rotation><translation>{_text(chunk[:3, 3])}"
        f"</translation><scale>{float(scale)!r}</scale></transform>"
    )
    inside = f'<components><component id="0">{transform}</component></components>' if newer else transform
    own = ' component_id="0"' if newer else ""
    cameras = []
    for number, (image, view) in enumerate(zip(scene.names, scene.viewmats)):
        pose = np.linalg.inv(chunk) @ np.linalg.inv(view)
        pose[:3, :3] *= scale
        cameras.append(
            f'<camera id="{number}" sensor_id="3" label="{Path(image).stem}"{own}><transform>{_text(pose)}</transform>'
            "</camera>"
        )
    path = scene.folder / "cameras.xml"
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0"><chunk label="Chunk 1" enabled="true">'
        f'<sensors><sensor id="3" label="lens" type="{kind}"><resolution width="{width}" height="{height}"/>'
        f'<calibration type="{kind}" class="initial"><f>1</f></calibration>'
        f'<calibration type="{kind}" class="adjusted"><resolution width="{width}" height="{height}"/>{calibration}'
        f"</calibration></sensor></sensors>{inside}<cameras><group>{''.join(cameras)}</group></cameras></chunk>"
        "</document>\n"
    )
    return path


def _text(matrix) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(matrix))
