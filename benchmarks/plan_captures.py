"""Derived captures for `benchmarks/plan.py`, with data that a plan can omit."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from backend.capture.capture import HOLDOUT_EVERY

UNSEEN = 0.3
"""Number of added points outside all views, as a fraction of the points."""

LENS = 1e-5
"""A radial distortion that moves each pixel of a 1,000-pixel image by less than a hundredth of a pixel."""


def with_masks(capture: Path, folder: Path, value: int) -> Path:
    """Copy a capture without masks to `folder` and add masks with the ID `value` in every pixel; 0 is no object."""
    for part in capture.iterdir():
        (folder / part.name).symlink_to(part)
    images = capture / "images"
    for image in images.rglob("*"):
        if image.is_file():
            path = (folder / "masks" / image.relative_to(images)).with_suffix(".png")
            path.parent.mkdir(parents=True, exist_ok=True)
            width, height = Image.open(image).size
            Image.fromarray(np.full((height, width), value, np.uint8)).save(path)
    return folder


def through_a_lens(capture: Path, folder: Path) -> Path:
    """Copy a capture of pinhole images to `folder` and give its cameras a negligible distortion."""
    model = _model(capture)
    for camera in model.cameras.values():
        fx, fy, cx, cy = camera.calibration_matrix()[[0, 1, 0, 1], [0, 1, 2, 2]]
        camera.model, camera.params = "OPENCV", [fx, fy, cx, cy, LENS, 0, 0, 0]
    for part in capture.iterdir():
        if part.name != "sparse":
            (folder / part.name).symlink_to(part)
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write(str(folder / "sparse" / "0"))
    return folder


def with_surplus(capture: Path, folder: Path, seed: int = 0) -> Path:
    """Copy a capture to `folder` and add redundant data.

    The number of photos about doubles: half of the added photos are JPEG copies, the others show nothing reconstructed.
    Points outside every photo are added, too (`UNSEEN`). The same photos are held out, each of them twice, and the same
    photos are trained on.
    """
    rng = np.random.default_rng(seed)
    model = _model(capture)
    images = sorted(model.images.values(), key=lambda image: image.name)
    held_out = images[::HOLDOUT_EVERY]
    trained = [image for i, image in enumerate(images) if i % HOLDOUT_EVERY]
    # Every 8th photo of the new capture is held out; these are exactly the old held-out photos, twice each.
    room = 2 * len(held_out) * (HOLDOUT_EVERY - 1) - len(trained)
    jpegs = trained[: room // 2]
    blind = [trained[i % len(trained)] for i in range(room - len(jpegs))]
    rest: list[tuple[Any, Callable[..., None]]] = [(image, _same) for image in trained]
    rest += [(image, _as_jpeg) for image in jpegs] + [(image, _as_wall) for image in blind]
    rest = [rest[i] for i in rng.permutation(len(rest))]
    twice = [(image, _same) for image in held_out for _ in range(2)]
    every = HOLDOUT_EVERY - 1
    order = [one for i, kept in enumerate(twice) for one in (kept, *rest[i * every : (i + 1) * every])]

    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    model.write_text(str(sparse))
    xyz = np.array([point.xyz for point in model.points3D.values()])
    lines, poses = [], []
    for place, (image, make) in enumerate(order):
        rotation, shift = _pose(image)
        name = f"{place:04d}{'.jpg' if make is _as_jpeg else Path(image.name).suffix}"
        if make is _as_wall:
            turn = _away_from(xyz, rotation, shift, image.camera, rng)
            rotation, shift = turn @ rotation, turn @ shift
        poses.append((rotation, shift, image.camera))
        make(capture, image.name, folder, name, rng)
        lines.append(f"{place + 1} {_numbers([*_quaternion(rotation), *shift])} {image.camera_id} {name}")
        seen = [] if make is _as_wall else [p for p in image.points2D if p.has_point3D()]
        lines.append(" ".join(f"{p.xy[0]:.3f} {p.xy[1]:.3f} {p.point3D_id}" for p in seen))
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    points = [
        f"{i} {_numbers(point.xyz)} {' '.join(map(str, point.color))} {point.error}"
        for i, point in model.points3D.items()
    ]
    first = max(model.points3D) + 1
    for i, far in enumerate(_unseen(xyz, poses, round(UNSEEN * len(xyz)), rng)):
        points.append(f"{first + i} {_numbers(far)} 128 128 128 1.0")
    (sparse / "points3D.txt").write_text("\n".join(points) + "\n")
    if (capture / "labels.json").exists():
        shutil.copy(capture / "labels.json", folder)
    return folder


def _model(capture: Path) -> Any:
    import pycolmap

    from backend.capture.colmap import find_model

    return pycolmap.Reconstruction(str(find_model(capture)[0]))


def _pose(image: Any) -> tuple[np.ndarray, np.ndarray]:
    pose = image.cam_from_world()
    return pose.rotation.matrix(), pose.translation


def _same(capture: Path, old: str, folder: Path, new: str, rng: np.random.Generator) -> None:
    _place(capture / "images" / old, folder / "images" / new)
    _copy_mask(capture, old, folder, new)


def _as_jpeg(capture: Path, old: str, folder: Path, new: str, rng: np.random.Generator) -> None:
    target = folder / "images" / new
    target.parent.mkdir(parents=True, exist_ok=True)
    Image.open(capture / "images" / old).convert("RGB").save(target, quality=97, subsampling=0)
    _copy_mask(capture, old, folder, new)


def _as_wall(capture: Path, old: str, folder: Path, new: str, rng: np.random.Generator) -> None:
    """Write an image of a uniform color with noise, as of a wall."""
    target = folder / "images" / new
    target.parent.mkdir(parents=True, exist_ok=True)
    width, height = Image.open(capture / "images" / old).size
    pixels = rng.uniform(40, 215, 3) + rng.normal(scale=6, size=(height, width, 3))
    Image.fromarray(pixels.clip(0, 255).astype(np.uint8)).save(target)


def _copy_mask(capture: Path, old: str, folder: Path, new: str) -> None:
    mask = (capture / "masks" / old).with_suffix(".png")
    if mask.exists():
        _place(mask, (folder / "masks" / new).with_suffix(".png"))


def _place(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    target.symlink_to(source.resolve())


def _away_from(xyz: np.ndarray, rotation: np.ndarray, shift: np.ndarray, camera: Any, rng: np.random.Generator) -> Any:
    """Return a rotation (3, 3) that turns the camera so that all points are well outside its image."""
    seen = xyz @ rotation.T + shift
    for _ in range(1000):
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        turn *= np.sign(np.linalg.det(turn))
        if not _in_image(seen @ turn.T, camera).any():
            return turn
    raise RuntimeError("a camera of this capture has points on all sides, so no rotation avoids them")


def _unseen(
    xyz: np.ndarray, poses: list[tuple[np.ndarray, np.ndarray, Any]], count: int, rng: np.random.Generator
) -> np.ndarray:
    """Return points (count, 3) around the scene, well outside all images; poses: (rotation, translation, camera)."""
    middle = np.median(xyz, axis=0)
    size = np.quantile(np.linalg.norm(xyz - middle, axis=1), 0.9)
    found = np.zeros((0, 3))
    for _ in range(1000):
        towards = rng.normal(size=(4 * count, 3))
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        some = middle + towards * size * rng.uniform(1, 6, (len(towards), 1))
        for rotation, shift, camera in poses:
            some = some[~_in_image(some @ rotation.T + shift, camera)]
        found = np.concatenate([found, some])
        if len(found) >= count:
            return found[:count]
    raise RuntimeError("the photos of this capture cover all directions, so no point is unseen")


def _in_image(points: np.ndarray, camera: Any) -> np.ndarray:
    """Return (n,) bool: whether camera-space points (n, 3) are in the image or within a quarter of its size of it."""
    K = camera.calibration_matrix()
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        pixels = (points @ K.T)[:, :2] / points[:, 2:]
    size = np.array([camera.width, camera.height])
    return (points[:, 2] > 0) & ((pixels > -size / 4) & (pixels < 1.25 * size)).all(1)


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """Convert a rotation matrix (3, 3) to a quaternion (w, x, y, z)."""
    import pycolmap

    x, y, z, w = pycolmap.Rotation3d(rotation).quat
    return np.array([w, x, y, z])


def _numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)
