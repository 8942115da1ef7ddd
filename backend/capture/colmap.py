"""Reads a COLMAP model: cameras, posed images and points, text or binary, with or without rigs and frames.

The files are parsed here and not by pycolmap, whose text reader cuts an image name at its first space and whose
binary reader trusts the counts in the file. COLMAP 3.12+ writes each image's own pose into images.* also where rigs
and frames exist, so rigs.* and frames.* add nothing that is needed here.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..protocol import InputError

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
"""COLMAP's number of each camera model: its name and how many parameters it has."""

_PARAMS_OF = {name: count for name, count in CAMERA_MODELS.values()}
_STEMS = ("cameras", "images", "points3D")
_AGAIN = "copy the model again, or export it anew from COLMAP"
_LARGEST_SIDE = 1 << 20


@dataclass(frozen=True)
class Camera:
    """One camera as COLMAP wrote it: size in pixels, parameters in COLMAP's order for `model`."""

    id: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class Image:
    """One posed image: viewmat (4,4) world to camera; xy (n,2) pixels of the observed points, point_index (n,)."""

    name: str
    camera_id: int
    viewmat: np.ndarray
    xy: np.ndarray
    point_index: np.ndarray


@dataclass(frozen=True)
class Model:
    """A whole model; images in the file's order; points as arrays of length M."""

    folder: Path
    suffix: str
    cameras: dict[int, Camera]
    images: list[Image]
    xyz: np.ndarray
    rgb: np.ndarray
    error: np.ndarray
    ids: np.ndarray
    warnings: list[str] = field(default_factory=list)

    def file(self, stem: str) -> Path:
        """The path of cameras, images or points3D, with the model's suffix."""
        return self.folder / f"{stem}{self.suffix}"


@dataclass
class _RawImage:
    name: str
    camera_id: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    xy: np.ndarray
    point_ids: np.ndarray


@dataclass
class _RawPoints:
    ids: np.ndarray
    xyz: np.ndarray
    rgb: np.ndarray
    error: np.ndarray


def find_model(folder: Path) -> tuple[Path, list[str]]:
    """The folder of the model inside a capture, and what to warn about.

    Looked for in sparse/0, sparse/1, ... (the one with the most images wins), sparse/ and the folder itself.
    """
    sparse = folder / "sparse"
    parents = [sparse, folder]
    numbered = (
        sorted((path for path in sparse.iterdir() if path.is_dir()), key=lambda p: p.name) if sparse.is_dir() else []
    )
    candidates = [path for path in [*numbered, *parents] if _has_any(path)]
    if not candidates:
        raise InputError(
            f"{folder} holds no COLMAP model: expected cameras, images and points3D (.bin or .txt) in {sparse / '0'}."
        )
    complete = [path for path in candidates if _suffix(path) is not None]
    if not complete:
        raise InputError(_missing(candidates[0]))
    within = [path for path in complete if path.parent == sparse]
    if len(within) < 2:
        return complete[0], []
    sizes = {path: _count_images(path) for path in within}
    best = max(within, key=lambda path: (sizes[path], -within.index(path)))
    others = ", ".join(f"{path.name} ({sizes[path]} images)" for path in within if path != best)
    return best, [f"{sparse} holds {len(within)} models: {best.name} ({sizes[best]} images) is used, not {others}."]


def read_model(folder: Path) -> Model:
    """Read and validate the model in `folder`; raises InputError that names the file which is wrong."""
    suffix = _suffix(folder)
    if suffix is None:
        raise InputError(_missing(folder))
    warnings: list[str] = []
    paths = {stem: folder / f"{stem}{suffix}" for stem in _STEMS}
    try:
        if suffix == ".bin":
            cameras = _cameras_bin(paths["cameras"])
            images = _images_bin(paths["images"])
            points = _points_bin(paths["points3D"])
        else:
            cameras = _cameras_txt(paths["cameras"])
            images = _images_txt(paths["images"], warnings)
            points = _points_txt(paths["points3D"], warnings)
    except OSError as error:
        raise InputError(f"{error.filename or folder} cannot be read ({error.strerror}); check the file.") from error
    return _validated(
        Model(folder, suffix, cameras, [], points.xyz, points.rgb, points.error, points.ids, warnings), images
    )


def _has_any(folder: Path) -> bool:
    return any((folder / f"{stem}{suffix}").is_file() for stem in _STEMS for suffix in (".bin", ".txt"))


def _suffix(folder: Path) -> str | None:
    for suffix in (".bin", ".txt"):
        if all((folder / f"{stem}{suffix}").is_file() for stem in _STEMS):
            return suffix
    return None


def _missing(folder: Path) -> str:
    absent = {s: [f"{stem}{s}" for stem in _STEMS if not (folder / f"{stem}{s}").is_file()] for s in (".bin", ".txt")}
    files = min(absent.values(), key=len)
    verb = "is" if len(files) == 1 else "are"
    return f"{' and '.join(files)} {verb} missing from {folder}: a COLMAP model needs cameras, images and points3D."


def _count_images(folder: Path) -> int:
    """How many images the model says it has; -1 where that cannot be told."""
    try:
        if _suffix(folder) == ".bin":
            with open(folder / "images.bin", "rb") as file:
                return int(struct.unpack("<Q", file.read(8))[0])
        with open(folder / "images.txt", "rb") as file:
            return sum(1 for line in file if not line.startswith(b"#")) // 2
    except (OSError, struct.error):
        return -1


# Binary


class _Reader:
    """Takes values off a file's bytes; every take is checked against the length."""

    def __init__(self, path: Path, what: str) -> None:
        self.path, self.what = path, what
        self.data = path.read_bytes()
        self.at = 0
        self.index = 0
        self.count = 0
        (self.count,) = self.take("<Q")

    def each(self) -> Iterator[int]:
        """Count up to what the file announces; where the reader stands is told if the file ends early."""
        while self.index < self.count:
            yield self.index
            self.index += 1

    def cut_short(self) -> InputError:
        if len(self.data) < 8:
            return InputError(f"{self.path} is cut short: it has only {len(self.data)} bytes; {_AGAIN}.")
        return InputError(
            f"{self.path} is cut short: it announces {self.count} {self.what} but ends within number {self.index + 1}; "
            f"{_AGAIN}."
        )

    def need(self, size: int) -> None:
        if size > len(self.data) - self.at:
            raise self.cut_short()

    def take(self, format: str) -> tuple:
        size = struct.calcsize(format)
        self.need(size)
        values = struct.unpack_from(format, self.data, self.at)
        self.at += size
        return values

    def array(self, dtype: np.dtype, count: int) -> np.ndarray:
        self.need(dtype.itemsize * count)
        values = np.frombuffer(self.data, dtype, count, self.at)
        self.at += dtype.itemsize * count
        return values

    def name(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise self.cut_short()
        raw = self.data[self.at : end]
        self.at = end + 1
        return _decoded(raw, self.path)


def _decoded(raw: bytes, path: Path) -> str:
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} names an image {raw!r}, which is not UTF-8; rename it and {_AGAIN}.") from error


def _cameras_bin(path: Path) -> dict[int, Camera]:
    reader = _Reader(path, "cameras")
    cameras: dict[int, Camera] = {}
    for _ in reader.each():
        camera_id, model_id, width, height = reader.take("<IiQQ")
        if model_id not in CAMERA_MODELS:
            raise InputError(
                f"{path} gives camera {camera_id} the model number {model_id}, which is not one of COLMAP's; {_AGAIN}."
            )
        name, count = CAMERA_MODELS[model_id]
        cameras[camera_id] = Camera(camera_id, name, width, height, reader.take(f"<{count}d"))
    return cameras


_OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<i8")])


def _images_bin(path: Path) -> list[_RawImage]:
    reader = _Reader(path, "images")
    images = []
    for _ in reader.each():
        values = reader.take("<I7dI")
        name = reader.name()
        (count,) = reader.take("<Q")
        observed = reader.array(_OBSERVATION, count)
        observed = observed[observed["point"] >= 0]
        images.append(
            _RawImage(name, values[8], values[1:5], values[5:8], observed["xy"].copy(), observed["point"].copy())
        )
    return images


_POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])


def _points_bin(path: Path) -> _RawPoints:
    reader = _Reader(path, "points")
    data, at, offsets = reader.data, reader.at, []
    length, head = struct.Struct("<Q"), _POINT.itemsize
    end = len(data) - head
    for _ in reader.each():
        if at > end:
            raise reader.cut_short()
        offsets.append(at)
        at += head + 8 * length.unpack_from(data, at + head - 8)[0]
    if at > len(data):
        raise reader.cut_short()
    points = np.empty(len(offsets), _POINT)
    rows = points.view(np.uint8).reshape(-1, head)
    flat = np.frombuffer(data, np.uint8)
    starts = np.array(offsets, np.int64)
    for first in range(0, len(starts), 65536):
        rows[first : first + 65536] = flat[starts[first : first + 65536, None] + np.arange(head)]
    return _RawPoints(points["id"].astype(np.int64), points["xyz"].copy(), points["rgb"].copy(), points["error"].copy())


# Text


def _lines(path: Path) -> list[bytes]:
    return [line.rstrip(b"\r") for line in path.read_bytes().split(b"\n")]


def _malformed(path: Path, number: int, expected: str) -> InputError:
    return InputError(f"{path} is malformed or cut short at line {number}: expected {expected}; {_AGAIN}.")


def _announced(lines: list[bytes], found: int, path: Path, what: str, warnings: list[str]) -> None:
    """The count in a text file's comment is only a comment, since people edit these files; but worth a warning."""
    for line in lines[:10]:
        match = re.match(rb"#\s*Number of \w+:\s*(\d+)", line)
        if match and int(match[1]) != found:
            warnings.append(f"{path} says that it holds {int(match[1])} {what}, but there are {found}.")
            return


def _cameras_txt(path: Path) -> dict[int, Camera]:
    cameras: dict[int, Camera] = {}
    for number, line in enumerate(_lines(path), 1):
        fields = line.split()
        if not fields or fields[0].startswith(b"#"):
            continue
        expected = "CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS"
        if len(fields) < 4:
            raise _malformed(path, number, expected)
        model = fields[1].decode("utf-8", "replace")
        if model not in _PARAMS_OF:
            raise InputError(f"{path} gives a camera the model {model}, which is not one of COLMAP's; {_AGAIN}.")
        if len(fields) != 4 + _PARAMS_OF[model]:
            raise _malformed(path, number, f"{_PARAMS_OF[model]} parameters of {model}")
        try:
            camera_id, width, height = int(fields[0]), int(fields[2]), int(fields[3])
            cameras[camera_id] = Camera(camera_id, model, width, height, tuple(float(f) for f in fields[4:]))
        except ValueError as error:
            raise _malformed(path, number, expected) from error
    return cameras


def _images_txt(path: Path, warnings: list[str]) -> list[_RawImage]:
    lines = _lines(path)
    images = []
    at = 0
    while at < len(lines):
        line = lines[at]
        at += 1
        if not line.strip() or line.startswith(b"#"):
            continue
        fields = line.split(None, 9)
        expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
        if len(fields) < 10:
            raise _malformed(path, at, expected)
        try:
            pose = tuple(float(f) for f in fields[1:8])
            camera_id = int(fields[8])
        except ValueError as error:
            raise _malformed(path, at, expected) from error
        observed = np.zeros((0, 3))
        if at < len(lines):
            try:
                observed = np.array(lines[at].split(), np.float64).reshape(-1, 3)
            except ValueError as error:
                raise _malformed(path, at + 1, "X Y POINT3D_ID for each observation of an image") from error
            at += 1
        # An absent point is -1, or 2^64 - 1 where something printed it unsigned.
        observed = observed[(observed[:, 2] >= 0) & (observed[:, 2] < 2.0**62)]
        name = _decoded(fields[9], path)
        images.append(_RawImage(name, camera_id, pose[:4], pose[4:], observed[:, :2], observed[:, 2].astype(np.int64)))
    _announced(lines, len(images), path, "images", warnings)
    return images


def _points_txt(path: Path, warnings: list[str]) -> _RawPoints:
    lines = _lines(path)
    ids, xyz, rgb, errors = [], [], [], []
    for number, line in enumerate(lines, 1):
        fields = line.split(None, 8)
        if not fields or fields[0].startswith(b"#"):
            continue
        try:
            if len(fields) < 8:
                raise ValueError
            ids.append(int(fields[0]))
            if not 0 <= ids[-1] < 2**63:
                raise ValueError
            xyz.append((float(fields[1]), float(fields[2]), float(fields[3])))
            rgb.append((int(fields[4]) & 255, int(fields[5]) & 255, int(fields[6]) & 255))
            errors.append(float(fields[7]))
        except ValueError as error:
            raise _malformed(path, number, "POINT3D_ID X Y Z R G B ERROR TRACK") from error
    _announced(lines, len(ids), path, "points", warnings)
    return _RawPoints(
        np.array(ids, np.int64),
        np.array(xyz, np.float64).reshape(-1, 3),
        np.array(rgb, np.uint8).reshape(-1, 3),
        np.array(errors, np.float64),
    )


# What both kinds must satisfy


def _validated(model: Model, raw: list[_RawImage]) -> Model:
    images_file, points_file = model.file("images"), model.file("points3D")
    if not raw:
        raise InputError(f"{images_file} holds no image with a pose; run COLMAP's mapper until it registers images.")
    used: set[int] = set()
    names: set[str] = set()
    for image in raw:
        if image.camera_id not in model.cameras:
            raise InputError(
                f"{images_file} gives image {image.name} the camera {image.camera_id}, which "
                f"{model.file('cameras').name} does not hold; {_AGAIN}."
            )
        if image.name in names:
            raise InputError(f"{images_file} holds two images named {image.name}; {_AGAIN}.")
        names.add(image.name)
        used.add(image.camera_id)
    for camera_id in sorted(used):
        _check_camera(model.cameras[camera_id], model.file("cameras"))

    finite = np.isfinite(model.xyz).all(1)
    if not finite.all():
        model.warnings.append(
            f"{points_file} holds {int((~finite).sum())} points that are not finite; they are left out."
        )
    if int(finite.sum()) < 4:
        raise InputError(f"{points_file} holds only {int(finite.sum())} points, and at least 4 are needed; {_AGAIN}.")
    xyz, ids = model.xyz[finite], model.ids[finite]
    order = np.argsort(ids, kind="stable")
    sorted_ids = ids[order]

    images = []
    for image in raw:
        at = np.minimum(np.searchsorted(sorted_ids, image.point_ids), len(ids) - 1)
        known = (sorted_ids[at] == image.point_ids) & np.isfinite(image.xy).all(1)
        viewmat = _viewmat(image, images_file)
        images.append(Image(image.name, image.camera_id, viewmat, image.xy[known], order[at[known]]))
    error = model.error[finite].astype(np.float32)
    return Model(model.folder, model.suffix, model.cameras, images, xyz, model.rgb[finite], error, ids, model.warnings)


def _check_camera(camera: Camera, path: Path) -> None:
    who = f"{path} gives camera {camera.id} ({camera.model})"
    if not (0 < camera.width <= _LARGEST_SIDE and 0 < camera.height <= _LARGEST_SIDE):
        raise InputError(f"{who} the impossible size {camera.width}x{camera.height}; {_AGAIN}.")
    if not all(math.isfinite(value) for value in camera.params):
        raise InputError(f"{who} parameters that are not numbers (NaN or infinite); {_AGAIN}.")


def _viewmat(image: _RawImage, path: Path) -> np.ndarray:
    q = np.array(image.quaternion, np.float64)
    t = np.array(image.translation, np.float64)
    norm = float(np.linalg.norm(q)) if np.isfinite(q).all() else math.nan
    if not (np.isfinite(t).all() and 1e-6 < norm < 1e6):
        raise InputError(
            f"{path} gives image {image.name} a pose that is not a number (NaN, infinite or zero); {_AGAIN}."
        )
    w, x, y, z = q / norm
    viewmat = np.eye(4)
    viewmat[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    viewmat[:3, 3] = t
    return viewmat


Problem = Callable[[str], None]
"""Takes one sentence about what is wrong; either raises it or collects it."""
