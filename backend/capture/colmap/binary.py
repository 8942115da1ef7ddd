"""Reader of the binary files of a COLMAP model: cameras.bin, images.bin and points3D.bin."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ...shared.errors import InputError
from ...shared.formats.regular_file import read_regular
from .model import CAMERA_MODELS, EXPORT_AGAIN, Camera, RawImage, RawPoints, decode_name

_OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])


class _Reader:
    """Sequential reader of a file's bytes; each read is checked against the file's length."""

    def __init__(self, path: Path, content: str) -> None:
        self.path, self.content = path, content
        self.data = read_regular(path)
        self.at = 0
        self.index = 0
        self.count = 0
        (self.count,) = self.take("<Q")

    def each(self) -> Iterator[int]:
        """Iterate over the entries counted in the header; `index` is the entry reported if the file ends early."""
        while self.index < self.count:
            yield self.index
            self.index += 1

    def truncated(self) -> InputError:
        """Return the error for a file that ends early."""
        if len(self.data) < 8:
            return InputError(f"{self.path} is truncated: it has only {len(self.data)} bytes; {EXPORT_AGAIN}.")
        return InputError(
            f"{self.path} is truncated: it declares {self.count} {self.content} but ends within number "
            f"{self.index + 1}; {EXPORT_AGAIN}."
        )

    def require(self, size: int) -> None:
        if size > len(self.data) - self.at:
            raise self.truncated()

    def take(self, format: str) -> tuple:
        size = struct.calcsize(format)
        self.require(size)
        values = struct.unpack_from(format, self.data, self.at)
        self.at += size
        return values

    def array(self, dtype: np.dtype, count: int) -> np.ndarray:
        self.require(dtype.itemsize * count)
        values = np.frombuffer(self.data, dtype, count, self.at)
        self.at += dtype.itemsize * count
        return values

    def name(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise self.truncated()
        raw = self.data[self.at : end]
        self.at = end + 1
        return decode_name(raw, self.path)


def read_cameras_binary(path: Path) -> dict[int, Camera]:
    """Read cameras.bin; returns the cameras by ID."""
    reader = _Reader(path, "cameras")
    cameras: dict[int, Camera] = {}
    for _ in reader.each():
        camera_id, model_id, width, height = reader.take("<IiQQ")
        if model_id not in CAMERA_MODELS:
            raise InputError(
                f"{path} gives camera {camera_id} the model number {model_id}, which is not one of COLMAP's; "
                f"{EXPORT_AGAIN}."
            )
        name, count = CAMERA_MODELS[model_id]
        cameras[camera_id] = Camera(camera_id, name, width, height, reader.take(f"<{count}d"))
    return cameras


def read_images_binary(path: Path) -> list[RawImage]:
    """Read images.bin; only observations of a triangulated point are kept."""
    reader = _Reader(path, "images")
    images = []
    for _ in reader.each():
        values = reader.take("<I7dI")
        name = reader.name()
        (count,) = reader.take("<Q")
        observed = reader.array(_OBSERVATION, count)
        observed = observed[observed["point"] >= 0]
        images.append(
            RawImage(name, values[8], values[1:5], values[5:8], observed["xy"].copy(), observed["point"].copy())
        )
    return images


def read_points_binary(path: Path) -> RawPoints:
    """Read points3D.bin without the tracks."""
    reader = _Reader(path, "points")
    data, at, offsets = reader.data, reader.at, []
    length, head = struct.Struct("<Q"), _POINT.itemsize
    end = len(data) - head
    for _ in reader.each():
        if at > end:
            raise reader.truncated()
        offsets.append(at)
        at += head + 8 * length.unpack_from(data, at + head - 8)[0]
    if at > len(data):
        raise reader.truncated()
    points = np.empty(len(offsets), _POINT)
    rows = points.view(np.uint8).reshape(-1, head)
    flat = np.frombuffer(data, np.uint8)
    starts = np.array(offsets, np.int64)
    for first in range(0, len(starts), 65536):
        rows[first : first + 65536] = flat[starts[first : first + 65536, None] + np.arange(head)]
    return RawPoints(points["id"].astype(np.int64), points["xyz"].copy(), points["rgb"].copy(), points["error"].copy())
