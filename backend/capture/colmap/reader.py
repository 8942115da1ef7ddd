"""Search and parsing of COLMAP models, text or binary, with or without rigs and frames.

pycolmap is not used for parsing: its text reader truncates image names at the first space, and its binary reader does
not check the counts in the file. COLMAP 3.12 and later writes each image's own pose to images.* even if rigs and frames
exist, so rigs.* and frames.* are not needed.
"""

from __future__ import annotations

import struct
from pathlib import Path

from ...shared.errors import InputError
from ...shared.formats.regular_file import open_regular
from .binary import read_cameras_binary, read_images_binary, read_points_binary
from .model import COLMAP, FILE_STEMS, Camera, Model, export_again
from .text import read_cameras_text, read_images_text, read_points_text
from .validate import check_camera, validate


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
    sparse, candidates = folder / "sparse", _candidates(folder)
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
    return validate(
        Model(folder, paths, cameras, [], points.xyz, points.rgb, points.error, points.ids, warnings), images
    )


def read_cameras(file: Path) -> dict[int, Camera]:
    """Read and check the cameras of a COLMAP model by ID.

    Args:
        file: cameras.bin, or text.

    Raises:
        InputError: The file is damaged.
    """
    try:
        cameras = read_cameras_binary(file) if file.suffix == ".bin" else read_cameras_text(file)
    except OSError as error:
        raise InputError(f"{file} cannot be read ({error.strerror}); check the file.") from error
    for camera in cameras.values():
        check_camera(camera, file, export_again(COLMAP))
    return cameras


def has_model(folder: Path) -> bool:
    """Return whether a capture has a COLMAP model, or a part of one."""
    return bool(_candidates(folder))


def _candidates(folder: Path) -> list[Path]:
    """Return the folders of a capture with files of a COLMAP model, in the order in which they are preferred."""
    sparse = folder / "sparse"
    numbered = (
        sorted((path for path in sparse.iterdir() if path.is_dir()), key=lambda p: p.name) if sparse.is_dir() else []
    )
    return [path for path in [*numbered, sparse, folder] if _has_any_file(path)]


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
