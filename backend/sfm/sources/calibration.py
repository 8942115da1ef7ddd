"""Lenses that are known: a file of COLMAP's with a camera for each size of photos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from ...capture.colmap import Camera, read_cameras
from ...capture.files import image_size
from ...shared.errors import InputError
from .photos import Photo

_FILES = ("cameras.bin", "cameras.txt")


def read_calibration(path: Path) -> dict[tuple[int, int], Camera]:
    """Read the cameras of a calibration by their size (width, height) in pixels.

    Args:
        path: COLMAP's cameras.bin or cameras.txt, or a folder with it.

    Raises:
        InputError: It does not exist, is invalid, has no camera, or several of a size.
    """
    file = next((path / name for name in _FILES if (path / name).is_file()), path)
    if not file.is_file():
        raise InputError(f"{path} is not a calibration; choose COLMAP's cameras.bin or cameras.txt, or its folder.")
    found: dict[tuple[int, int], Camera] = {}
    for camera in read_cameras(file).values():
        size = (camera.width, camera.height)
        if size in found:
            raise InputError(f"{file} has several cameras of {size[0]}x{size[1]} pixels; keep one of each size.")
        found[size] = camera
    if not found:
        raise InputError(f"{file} contains no camera; calibrate one with photos of a target.")
    return found


def photos_by_camera(
    photos: Sequence[Photo], images: Path, calibration: Mapping[tuple[int, int], Camera], path: Path
) -> list[tuple[list[str], Camera]]:
    """Return the names of the photos of each camera of a calibration, with the camera.

    Args:
        photos: of the folder `images`.
        images: the folder.
        calibration: cameras by size.
        path: of the calibration, for messages.

    Raises:
        InputError: A photo has another size.
    """
    found: dict[tuple[int, int], list[str]] = {}
    for photo in photos:
        size = image_size(images / photo.name)
        if size not in calibration:
            raise InputError(
                f"{path} has no camera of {size[0]}x{size[1]} pixels, the size of {photo.name}; add one, or leave the "
                "photo out."
            )
        found.setdefault(size, []).append(photo.name)
    return [(names, calibration[size]) for size, names in found.items()]
