"""Data types of a model of cameras and points, before and after validation; names and conventions are COLMAP's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ...shared.errors import InputError

CAMERA_MODELS: dict[int, tuple[str, int]] = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
"""Camera models by COLMAP's model ID: name and number of parameters."""

FILE_STEMS = ("cameras", "images", "points3D")
"""The names of a model's files, without suffix."""

COLMAP = "COLMAP"


def export_again(program: str) -> str:
    """Return the advice at the end of error messages about damaged files of a program."""
    return f"copy the model again, or export it again from {program}"


EXPORT_AGAIN = export_again(COLMAP)


@dataclass(frozen=True)
class Camera:
    """One COLMAP camera: size in pixels, parameters in COLMAP's order for `model`."""

    id: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class Image:
    """One posed image: viewmat (4, 4) world to camera; xy (n, 2) pixels and point_index (n,) of the observed points."""

    name: str
    camera_id: int
    viewmat: np.ndarray
    xy: np.ndarray
    point_index: np.ndarray


@dataclass(frozen=True)
class Model:
    """A whole model: images in the file's order, points as arrays of length M.

    Attributes:
        folder: The folder of the model's files.
        files: The files with the cameras, images and points, by the stems in FILE_STEMS.
        cameras: Cameras by ID.
        images: Images with a pose.
        xyz: (M, 3) float64, world.
        rgb: (M, 3) uint8.
        error: (M,) float32, reprojection error in pixels, negative where unknown.
        ids: (M,) int64, distinct.
        warnings: Warnings for the user.
        program: The program that made the model, for messages.
        absent: Names of images that were left out because their photos are missing.
    """

    folder: Path
    files: Mapping[str, Path]
    cameras: dict[int, Camera]
    images: list[Image]
    xyz: np.ndarray
    rgb: np.ndarray
    error: np.ndarray
    ids: np.ndarray
    warnings: list[str] = field(default_factory=list)
    program: str = COLMAP
    absent: tuple[str, ...] = ()

    def file(self, stem: str) -> Path:
        """Return the path of the file with the cameras, images or points3D."""
        return self.files[stem]


@dataclass
class RawImage:
    """One image as stored in the file, before validation: quaternion (w, x, y, z) and translation, world to camera."""

    name: str
    camera_id: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    xy: np.ndarray
    point_ids: np.ndarray


@dataclass
class RawPoints:
    """All points as stored in the file, before validation."""

    ids: np.ndarray
    xyz: np.ndarray
    rgb: np.ndarray
    error: np.ndarray


def decode_name(raw: bytes, path: Path) -> str:
    """Decode an image name; raises InputError with the file's path if it is not UTF-8."""
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} names an image {raw!r}, which is not UTF-8; rename it and {EXPORT_AGAIN}.") from error
