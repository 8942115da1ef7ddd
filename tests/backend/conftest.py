"""Fixtures: tiny synthetic captures (colored spheres, a ring of cameras, exact masks and tracks), and commands."""

from __future__ import annotations

import json
import shutil
import struct
import sys
from pathlib import Path

import numba
import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image

from backend.capture import load_capture
from backend.cli import main as arguments
from backend.labels import vote

from .command_result import CommandResult

EMULATES = sys.platform == "linux" and shutil.which("g++") is not None
NO_EMULATOR = "the emulation of a GPU needs g++ on Linux"

MODELS = [
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION",
    "DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "EUCM", "EQUIRECTANGULAR",
]  # fmt: skip
SPHERES = [(1, (-0.7, 0.0, 0.0), 0.5), (2, (0.7, 0.1, 0.0), 0.45), (5, (0.0, -0.2, 0.9), 0.35)]


class Scene:
    """A capture written by `write_scene`, and its exact data."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.camera: tuple[str, int, int, list[float]] = ("PINHOLE", 96, 72, [])
        self.names: list[str] = []
        self.quaternions: list[np.ndarray] = []
        self.viewmats: list[np.ndarray] = []
        self.ids: list[np.ndarray] = []
        self.depths: list[np.ndarray] = []
        self.xyz = np.zeros((0, 3))
        self.rgb = np.zeros((0, 3), np.uint8)
        self.point_objects = np.zeros(0, np.int64)
        self.seen: list[np.ndarray] = []
        self.pixels: list[np.ndarray] = []

    def lens(self) -> pycolmap.Camera:
        model, width, height, params = self.camera
        return pycolmap.Camera(model=model, width=width, height=height, params=params)


def rays_of(lens: pycolmap.Camera) -> np.ndarray:
    """Return the viewing direction of each pixel's center, (h, w, 3) with z = 1."""
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    xy = np.asarray(lens.cam_from_img(np.stack([x.ravel(), y.ravel()], 1)))
    return np.column_stack([xy, np.ones(len(xy))]).reshape(lens.height, lens.width, 3)


def sphere_ids(rays: np.ndarray, viewmat: np.ndarray, spheres: list) -> tuple[np.ndarray, np.ndarray]:
    """Return the object ID that each ray (..., 3) hits first (0: none), and the distance along the ray (inf: none)."""
    best, ids = np.full(rays.shape[:-1], np.inf), np.zeros(rays.shape[:-1], np.int64)
    for object_id, center, radius in spheres:
        c = viewmat[:3, :3] @ center + viewmat[:3, 3]
        a, b = (rays * rays).sum(-1), rays @ c
        root = b * b - a * (c @ c - radius * radius)
        with np.errstate(invalid="ignore"):
            t = (b - np.sqrt(root)) / a
        nearer = (root > 0) & (t > 0) & (t < best)
        best, ids = np.where(nearer, t, best), np.where(nearer, object_id, ids)
    return ids, best


def look_at(camera_center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the quaternion (w, x, y, z) and world-to-camera matrix of a camera that looks at the origin."""
    forward = -camera_center / np.linalg.norm(camera_center)
    right = np.cross(forward, [0.0, -1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    x, y, z, w = pycolmap.Rotation3d(rotation).quat
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ camera_center
    return np.array([w, x, y, z]), viewmat


def write_model(scene: Scene, folder: Path, suffix: str) -> None:
    """Write the scene's COLMAP model, binary or text."""
    folder.mkdir(parents=True, exist_ok=True)
    model, width, height, params = scene.camera
    tracks: dict[int, list[tuple[int, int]]] = {i: [] for i in range(len(scene.xyz))}
    for view, seen in enumerate(scene.seen):
        for at, point in enumerate(seen):
            tracks[int(point)].append((view + 1, at))
    if suffix == ".bin":
        data = struct.pack("<QIiQQ", 1, 1, MODELS.index(model), width, height) + struct.pack(
            f"<{len(params)}d", *params
        )
        (folder / "cameras.bin").write_bytes(data)
        data = struct.pack("<Q", len(scene.names))
        for view, name in enumerate(scene.names):
            pose = [*scene.quaternions[view], *scene.viewmats[view][:3, 3]]
            data += struct.pack("<I7dI", view + 1, *pose, 1) + name.encode() + b"\0"
            data += struct.pack("<Q", len(scene.seen[view]))
            for (x, y), point in zip(scene.pixels[view], scene.seen[view]):
                data += struct.pack("<ddq", x, y, 10 * int(point) + 3)
        (folder / "images.bin").write_bytes(data)
        data = struct.pack("<Q", len(scene.xyz))
        for point, xyz in enumerate(scene.xyz):
            data += struct.pack("<Q3d3BdQ", 10 * point + 3, *xyz, *scene.rgb[point], 0.5, len(tracks[point]))
            data += b"".join(struct.pack("<II", *entry) for entry in tracks[point])
        (folder / "points3D.bin").write_bytes(data)
        return
    (folder / "cameras.txt").write_text(
        f"# cameras\n1 {model} {width} {height} {' '.join(map(repr, map(float, params)))}\n"
    )
    lines = ["# Image list", f"# Number of images: {len(scene.names)}"]
    for view, name in enumerate(scene.names):
        pose = " ".join(repr(float(v)) for v in [*scene.quaternions[view], *scene.viewmats[view][:3, 3]])
        lines.append(f"{view + 1} {pose} 1 {name}")
        seen = zip(scene.pixels[view], scene.seen[view])
        lines.append(" ".join(f"{float(x)!r} {float(y)!r} {10 * int(p) + 3}" for (x, y), p in seen))
    (folder / "images.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    lines = ["# 3D point list"]
    for point, xyz in enumerate(scene.xyz):
        track = " ".join(f"{image} {at}" for image, at in tracks[point])
        color = " ".join(map(str, scene.rgb[point]))
        lines.append(f"{10 * point + 3} {' '.join(repr(float(v)) for v in xyz)} {color} 0.5 {track}")
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")


def write_scene(
    folder, views=6, size=(96, 72), model="PINHOLE", params=None, masks=True, suffix=".bin", names=None,
    spheres=SPHERES, points=60, seed=0,
) -> Scene:  # fmt: skip
    """Write a capture to a folder.

    Args:
        size: (width, height) of the images.
        model, params: COLMAP camera; by default PINHOLE with the image width as focal length.
        masks: whether masks are written.
        suffix: ".bin" or ".txt", the format of the COLMAP model.
        names: image names, one per view.
        spheres: (ID, center, radius) of each sphere.
        points: number of points on each sphere.
    """
    rng = np.random.default_rng(seed)
    scene = Scene(folder)
    width, height = size
    params = params or [width, width, width / 2, height / 2]
    scene.camera = (model, width, height, params)
    scene.names = names or [f"view_{i:03d}.png" for i in range(views)]
    directions = rng.normal(size=(len(spheres), points, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    scene.xyz = np.concatenate([c + r * d for (_, c, r), d in zip(spheres, directions)])
    scene.rgb = np.array([(10, 20, i % 256) for i in range(len(scene.xyz))], np.uint8)
    scene.point_objects = np.repeat([i for i, _, _ in spheres], points)
    lens = scene.lens()
    rays = rays_of(lens)
    for view, image_name in enumerate(scene.names):
        angle = 2 * np.pi * view / len(scene.names)
        quaternion, viewmat = look_at(np.array([4 * np.sin(angle), -0.8, 4 * np.cos(angle)]))
        scene.quaternions.append(quaternion)
        scene.viewmats.append(viewmat)
        ids, depth = sphere_ids(rays, viewmat, spheres)
        scene.ids.append(ids)
        scene.depths.append(depth)
        path = scene.folder / "images" / image_name
        path.parent.mkdir(parents=True, exist_ok=True)
        shade = np.where(np.isfinite(depth), 255 / (1 + depth**2 / 8), 30)
        image = np.stack([shade, (ids * 40) % 256, 255 - shade], -1).astype(np.uint8)
        Image.fromarray(image).save(path, quality=95)
        if masks:
            path = (scene.folder / "masks" / image_name).with_suffix(".png")
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(ids.astype(np.uint16)).save(path)
        camera_xyz = scene.xyz @ viewmat[:3, :3].T + viewmat[:3, 3]
        pixels = np.asarray(lens.img_from_cam(camera_xyz))
        _, nearest = sphere_ids(camera_xyz / camera_xyz[:, 2:], viewmat, spheres)
        inside = (pixels >= 0).all(1) & (pixels < size).all(1) & (camera_xyz[:, 2] > 0)
        seen = np.flatnonzero(inside & (camera_xyz[:, 2] <= nearest * (1 + 1e-6)))
        scene.seen.append(seen)
        scene.pixels.append(pixels[seen])
    if masks:
        labels = {str(i): f"sphere {i}" for i, _, _ in spheres}
        (scene.folder / "labels.json").write_text(json.dumps({"0": "unlabeled", **labels}))
    write_model(scene, scene.folder / "sparse" / "0", suffix)
    return scene


@pytest.fixture
def emulate_gpu(monkeypatch):
    """Function that begins (True) or ends (False) the emulation of a GPU."""
    if not EMULATES:
        pytest.skip(NO_EMULATOR)
    return lambda answer=True: monkeypatch.setenv("OBJECTGS_EMULATE_GPU", "1" if answer else "0")


@pytest.fixture(scope="session", autouse=True)
def no_trained_networks(tmp_path_factory):
    """Give torch an empty cache of networks, so that no result depends on what is installed on this computer."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCH_HOME", str(tmp_path_factory.mktemp("torch")))
        yield


@pytest.fixture
def write_capture(tmp_path):
    """Function that runs `write_scene` in the test's own folder `name`."""

    def write(name="capture", **options) -> Scene:
        return write_scene(tmp_path / name, **options)

    # Offered as attributes, since test folders are not packages.
    write.sphere_ids, write.write_model, write.rays_of = sphere_ids, write_model, rays_of
    return write


@pytest.fixture
def run_command(capsys):
    """Function that runs a command in this process; with `--json`, the result has events."""
    threads = numba.get_num_threads(), torch.get_num_threads()

    def run(*words) -> CommandResult:
        capsys.readouterr()
        code = arguments.main([*map(str, words), "--threads", "1"])
        captured = capsys.readouterr()
        return CommandResult(code, captured.out, captured.err)

    yield run
    numba.set_num_threads(threads[0])
    torch.set_num_threads(threads[1])


_NO_DENSE_POINTS = ("backend.commands.capture.sfm._densify", lambda *_: {})


@pytest.fixture(scope="module")
def module_without_dense_points():
    """Leave out the points on plain surfaces, which `test_sfm` covers, to save time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(*_NO_DENSE_POINTS)
        yield


@pytest.fixture
def no_dense_points(monkeypatch):
    """As `module_without_dense_points`, for one test."""
    monkeypatch.setattr(*_NO_DENSE_POINTS)


@pytest.fixture
def tiny(write_capture, tmp_path):
    """Function that writes a capture of nine small views and returns it with the object IDs of its points."""

    def make(**options):
        scene = write_capture(views=9, size=(64, 48), **options)
        capture = load_capture(scene.folder, tmp_path / "cache")
        ids = vote(capture).ids if capture.has_masks else np.zeros(len(capture.points.xyz), np.int64)
        return capture, ids

    return make
