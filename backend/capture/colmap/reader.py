"""Search, parsing and validation of COLMAP models, text or binary, with or without rigs and frames.

pycolmap is not used for parsing: its text reader truncates image names at the first space, and its binary reader does
not check the counts in the file. COLMAP 3.12 and later writes each image's own pose to images.* even if rigs and frames
exist, so rigs.* and frames.* are not needed.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np

from ...shared.errors import InputError
from ...shared.formats.regular_file import open_regular
from .binary import read_cameras_binary, read_images_binary, read_points_binary
from .model import EXPORT_AGAIN, FILE_STEMS, Camera, Image, Model, RawImage
from .text import read_cameras_text, read_images_text, read_points_text

_LARGEST_SIDE = 1 << 20
_FARTHEST = 1e12
"""Largest absolute coordinate of points and cameras; beyond, distances have no precision left."""


def find_model(folder: Path) -> tuple[Path, list[str]]:
    """Find the COLMAP model of a capture.

    Searches sparse/0, sparse/1, ... (the model with the most images is used), then sparse/, then the folder itself.

    Args:
        folder: The capture.

    Returns:
        The model's folder, and warnings for the user.

    Raises:
        InputError: There is no complete model.
    """
    sparse = folder / "sparse"
    parents = [sparse, folder]
    numbered = (
        sorted((path for path in sparse.iterdir() if path.is_dir()), key=lambda p: p.name) if sparse.is_dir() else []
    )
    candidates = [path for path in [*numbered, *parents] if _has_any_file(path)]
    if not candidates:
        raise InputError(
            f"{folder} contains no COLMAP model: expected cameras, images and points3D (.bin or .txt) in "
            f"{sparse / '0'}."
        )
    complete = [path for path in candidates if _suffix_of(path) is not None]
    if not complete:
        raise InputError(_describe_missing(candidates[0]))
    within = [path for path in complete if path.parent == sparse]
    if len(within) < 2:
        return complete[0], []
    sizes = {path: _count_images(path) for path in within}
    best = max(within, key=lambda path: (sizes[path], -within.index(path)))
    others = ", ".join(f"{path.name} ({sizes[path]} images)" for path in within if path != best)
    return best, [f"{sparse} contains {len(within)} models: {best.name} ({sizes[best]} images) is used, not {others}."]


def read_model(folder: Path) -> Model:
    """Read and validate a COLMAP model.

    Args:
        folder: Folder with cameras, images and points3D, all .bin or all .txt.

    Returns:
        The model; points with NaN or Inf are left out, with a warning.

    Raises:
        InputError: A file is missing or damaged; the message names it.
    """
    suffix = _suffix_of(folder)
    if suffix is None:
        raise InputError(_describe_missing(folder))
    warnings: list[str] = []
    paths = {stem: folder / f"{stem}{suffix}" for stem in FILE_STEMS}
    try:
        if suffix == ".bin":
            cameras = read_cameras_binary(paths["cameras"])
            images = read_images_binary(paths["images"])
            points = read_points_binary(paths["points3D"])
        else:
            cameras = read_cameras_text(paths["cameras"])
            images = read_images_text(paths["images"], warnings)
            points = read_points_text(paths["points3D"], warnings)
    except OSError as error:
        raise InputError(f"{error.filename or folder} cannot be read ({error.strerror}); check the file.") from error
    return _validate(
        Model(folder, suffix, cameras, [], points.xyz, points.rgb, points.error, points.ids, warnings), images
    )


def _has_any_file(folder: Path) -> bool:
    return any((folder / f"{stem}{suffix}").is_file() for stem in FILE_STEMS for suffix in (".bin", ".txt"))


def _suffix_of(folder: Path) -> str | None:
    for suffix in (".bin", ".txt"):
        if all((folder / f"{stem}{suffix}").is_file() for stem in FILE_STEMS):
            return suffix
    return None


def _describe_missing(folder: Path) -> str:
    absent = {
        s: [f"{stem}{s}" for stem in FILE_STEMS if not (folder / f"{stem}{s}").is_file()] for s in (".bin", ".txt")
    }
    files = min(absent.values(), key=len)
    verb = "is" if len(files) == 1 else "are"
    return f"{' and '.join(files)} {verb} missing from {folder}: a COLMAP model needs cameras, images and points3D."


def _count_images(folder: Path) -> int:
    """Return the number of images according to the model's header; -1 if unknown."""
    try:
        if _suffix_of(folder) == ".bin":
            with open_regular(folder / "images.bin") as file:
                return int(struct.unpack("<Q", file.read(8))[0])
        with open_regular(folder / "images.txt") as file:
            return sum(1 for line in file if not line.startswith(b"#")) // 2
    except (OSError, struct.error):
        return -1


def _validate(model: Model, raw: list[RawImage]) -> Model:
    images_file, points_file = model.file("images"), model.file("points3D")
    if not raw:
        raise InputError(f"{images_file} contains no image with a pose; run COLMAP's mapper until it registers images.")
    used: set[int] = set()
    names: set[str] = set()
    for image in raw:
        if image.camera_id not in model.cameras:
            raise InputError(
                f"{images_file} gives image {image.name} the camera {image.camera_id}, which "
                f"{model.file('cameras').name} does not hold; {EXPORT_AGAIN}."
            )
        if image.name in names:
            raise InputError(f"{images_file} contains two images named {image.name}; {EXPORT_AGAIN}.")
        names.add(image.name)
        used.add(image.camera_id)
    for camera_id in sorted(used):
        _check_camera(model.cameras[camera_id], model.file("cameras"))

    with np.errstate(invalid="ignore"):
        finite = (np.abs(model.xyz) <= _FARTHEST).all(1)
    if not finite.all():
        model.warnings.append(
            f"{points_file} contains {int((~finite).sum())} points whose coordinates are not finite or exceed "
            f"{_FARTHEST:g}; they are left out."
        )
    if int(finite.sum()) < 4:
        raise InputError(
            f"{points_file} contains only {int(finite.sum())} points, and at least 4 are needed; {EXPORT_AGAIN}."
        )
    xyz, ids = model.xyz[finite], model.ids[finite]
    order = np.argsort(ids, kind="stable")
    sorted_ids = ids[order]

    images = []
    for image in raw:
        at = np.minimum(np.searchsorted(sorted_ids, image.point_ids), len(ids) - 1)
        known = (sorted_ids[at] == image.point_ids) & np.isfinite(image.xy).all(1)
        viewmat = _compute_viewmat(image, images_file)
        images.append(Image(image.name, image.camera_id, viewmat, image.xy[known], order[at[known]]))
    largest = np.finfo(np.float32).max
    error = np.clip(model.error[finite], -largest, largest).astype(np.float32)
    return Model(model.folder, model.suffix, model.cameras, images, xyz, model.rgb[finite], error, ids, model.warnings)


def _check_camera(camera: Camera, path: Path) -> None:
    who = f"{path} gives camera {camera.id} ({camera.model})"
    if not (0 < camera.width <= _LARGEST_SIDE and 0 < camera.height <= _LARGEST_SIDE):
        raise InputError(f"{who} the impossible size {camera.width}x{camera.height}; {EXPORT_AGAIN}.")
    if not all(math.isfinite(value) for value in camera.params):
        raise InputError(f"{who} parameters that are not numbers (NaN or infinite); {EXPORT_AGAIN}.")


def _compute_viewmat(image: RawImage, path: Path) -> np.ndarray:
    q = np.array(image.quaternion, np.float64)
    t = np.array(image.translation, np.float64)
    with np.errstate(over="ignore"):
        norm = float(np.linalg.norm(q)) if np.isfinite(q).all() else math.nan
    if not (np.isfinite(t).all() and 1e-6 < norm < 1e6):
        raise InputError(
            f"{path} gives image {image.name} a pose that is not a number (NaN, infinite or zero); {EXPORT_AGAIN}."
        )
    if np.abs(t).max() > _FARTHEST:
        raise InputError(f"{path} gives image {image.name} a position beyond {_FARTHEST:g}; {EXPORT_AGAIN}.")
    w, x, y, z = q / norm
    viewmat = np.eye(4)
    viewmat[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    viewmat[:3, 3] = t
    return viewmat
