"""Captures written from datasets: COLMAP models that are copied or made of poses, photos, ID masks and splits."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from backend.capture.colmap import Model, find_model, read_model
from backend.capture.colmap.model import FILE_STEMS
from backend.capture.undistort import pinhole_for, resample_mask
from backend.shared.defaults import MAX_SIZE
from backend.shared.errors import InputError
from backend.shared.formats.json_file import write_json


class Frame(NamedTuple):
    """A pinhole photo with its pose and object IDs.

    Attributes:
        name: file name in the capture.
        pixels: (H, W, 3) uint8, or the file to copy.
        K: (3, 3), in pixels; the center of the first pixel is (0.5, 0.5).
        viewmat: (4, 4), world to camera, OpenCV axes.
        ids: (H, W) object IDs from 0 to 65535, 0 where unlabeled.
        held_out: whether it is not trained on.
    """

    name: str
    pixels: np.ndarray | Path
    K: np.ndarray
    viewmat: np.ndarray
    ids: np.ndarray
    held_out: bool


def need(path: Path, what: str) -> Path:
    """Return `path`; raise InputError that says what it is if it does not exist."""
    if not path.exists():
        raise InputError(f"{path} does not exist; expected {what}.")
    return path


def read_pixels(path: Path) -> np.ndarray:
    """Read the pixels of an image as they are stored; raise InputError that names the file."""
    try:
        with Image.open(path) as image:
            return np.asarray(image)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path} cannot be read as an image; put it back or replace it.") from error


def read_binary_mask(path: Path) -> np.ndarray:
    """Read a mask of one object as (H, W) bool: the pixels above half of the largest value."""
    try:
        with Image.open(path) as image:
            gray = np.asarray(image.convert("L")).astype(np.int64)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path} cannot be read as an image; put it back or replace it.") from error
    return 2 * gray > gray.max()


def write_capture(
    folder: Path, frames: Iterable[Frame], xyz: np.ndarray, rgb: np.ndarray, names: Mapping[int, str]
) -> None:
    """Write a capture of pinhole photos.

    Args:
        folder: A folder that does not exist.
        frames: The views; each is written before the next one is taken.
        xyz, rgb: (M, 3) points in the world, and their colors as uint8.
        names: Names of the objects by ID.
    """
    cameras: dict[tuple[float, ...], int] = {}
    images, held_out = [], []
    for number, frame in enumerate(frames, 1):
        _write_photo(folder / "images" / frame.name, frame.pixels)
        mask = (folder / "masks" / frame.name).with_suffix(".png")
        mask.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(frame.ids.astype(np.uint16)).save(mask)
        height, width = frame.ids.shape
        K = frame.K
        lens = (width, height, *map(float, (K[0, 0], K[1, 1], K[0, 2], K[1, 2])))
        camera = cameras.setdefault(lens, len(cameras) + 1)
        pose = [*Rotation.from_matrix(frame.viewmat[:3, :3]).as_quat(scalar_first=True), *frame.viewmat[:3, 3]]
        images.append(f"{number} {' '.join(repr(float(value)) for value in pose)} {camera} {frame.name}\n\n")
        if frame.held_out:
            held_out.append(frame.name)
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    lenses = [f"{i} PINHOLE {' '.join(map(repr, lens))}\n" for lens, i in cameras.items()]
    points = [
        f"{i} {x!r} {y!r} {z!r} {r} {g} {b} 0\n"
        for i, ((x, y, z), (r, g, b)) in enumerate(zip(xyz.tolist(), rgb.tolist(), strict=True), 1)
    ]
    for stem, lines in zip(FILE_STEMS, (lenses, images, points), strict=True):
        (sparse / f"{stem}.txt").write_text("".join(lines), encoding="utf-8")
    write_json(folder / "labels.json", {str(i): name for i, name in names.items()})
    write_split(folder, held_out)


def _write_photo(path: Path, pixels: np.ndarray | Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(pixels, Path):
        shutil.copyfile(pixels, path)
    else:
        Image.fromarray(pixels).save(path)


def write_split(folder: Path, held_out: Sequence[str]) -> None:
    """Write test.txt of a capture."""
    (folder / "test.txt").write_text("".join(f"{name}\n" for name in held_out), encoding="utf-8")


def read_colmap(scene: Path) -> Model:
    """Read the COLMAP model of a scene: sparse/0, sparse or beside the photos."""
    return read_model(find_model(scene)[0])


def copy_capture(scene: Path, folder: Path, model: Model, masks: Path, held_out: Sequence[str]) -> None:
    """Write a capture with the COLMAP model of a scene.

    Args:
        scene: The scene, with photos in images/.
        folder: A folder that does not exist.
        model: The scene's model.
        masks: Folder with NAME.png for the photo NAME: the object IDs, of the training views at least.
        held_out: Names of the held-out views, whose masks are not copied.
    """
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    for stem in FILE_STEMS:
        shutil.copyfile(model.file(stem), sparse / model.file(stem).name)
    for image in model.images:
        photo = scene / "images" / image.name
        if photo.exists():
            _write_photo(folder / "images" / image.name, photo)
        mask = masks / f"{Path(image.name).stem}.png"
        if image.name not in held_out and mask.exists():
            _write_photo((folder / "masks" / image.name).with_suffix(".png"), mask)
    if not (folder / "masks").exists():
        raise InputError(f"{masks} has no mask of a training view; expected PNGs of object IDs, named as the photos.")
    write_split(folder, held_out)


def as_seen(capture: Path, masks: Mapping[str, Mapping[str, np.ndarray]]) -> dict[str, dict[str, np.ndarray]]:
    """Resample masks of photos to the views that are trained: undistorted, and reduced where the photo is too large.

    Args:
        capture: The capture.
        masks: View name -> prompt -> mask of the photo (H, W) bool.

    Returns:
        View name -> prompt -> mask of the view (h, w) bool.
    """
    model = read_colmap(capture)
    camera_of = {image.name: model.cameras[image.camera_id] for image in model.images}
    seen = {}
    for view, of_view in masks.items():
        camera = camera_of[view]
        target = pinhole_for(camera, model.file("cameras"), MAX_SIZE)
        seen[view] = {
            prompt: resample_mask(mask.astype(np.uint8), camera, target) > 0 for prompt, mask in of_view.items()
        }
    return seen
