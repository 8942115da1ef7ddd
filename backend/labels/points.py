"""The labelled point cloud as PLY: double coordinates (captures may be georeferenced) and a 32-bit `object_id`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..capture import Points
from ..protocol import InputError, write_atomic
from .voting import Votes

_VERTEX = np.dtype([("xyz", "<f8", 3), ("rgb", "u1", 3), ("object_id", "<u4"), ("margin", "<f4"), ("votes", "<u4")])
_PROPERTIES = (
    *(f"property double {axis}" for axis in "xyz"),
    *(f"property uchar {colour}" for colour in ("red", "green", "blue")),
    "property uint object_id",
    "property float margin",
    "property uint votes",
)


@dataclass(frozen=True)
class LabelledPoints:
    """xyz (M,3) float64 world, rgb (M,3) uint8, ids (M,) int64 object of each point (0: none), margins (M,) float32
    in [0, 1], visible (M,) int32 how many views voted."""

    xyz: np.ndarray
    rgb: np.ndarray
    ids: np.ndarray
    margins: np.ndarray
    visible: np.ndarray


def _header(count: int) -> bytes:
    lines = ("ply", "format binary_little_endian 1.0", f"element vertex {count}", *_PROPERTIES, "end_header", "")
    return "\n".join(lines).encode("ascii")


def write_points(path: Path, points: Points, votes: Votes) -> None:
    """Write the points with their labels to `path`, atomically."""
    vertices = np.empty(len(points.xyz), _VERTEX)
    vertices["xyz"], vertices["rgb"] = points.xyz, points.rgb
    vertices["object_id"], vertices["margin"], vertices["votes"] = votes.ids, votes.margins, votes.visible
    write_atomic(path, _header(len(vertices)) + vertices.tobytes())


def read_points(path: Path) -> LabelledPoints:
    """Read what `write_points` wrote; raises InputError that names the file when it is anything else."""
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist; run the vote first.") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); check the file.") from error
    start = data.find(b"end_header\n") + len(b"end_header\n")
    match = re.search(rb"element vertex (\d{1,12})\n", data[:start])
    count = int(match[1]) if match else -1
    if count < 0 or data[:start] != _header(count):
        raise InputError(f"{path} is not a labelled point cloud of this program; run the vote again.")
    if len(data) - start != count * _VERTEX.itemsize:
        raise InputError(f"{path} is cut short or overlong for {count} points; run the vote again.")
    vertices = np.frombuffer(data, _VERTEX, count, start)
    return LabelledPoints(
        vertices["xyz"].copy(),
        vertices["rgb"].copy(),
        vertices["object_id"].astype(np.int64),
        vertices["margin"].copy(),
        vertices["votes"].astype(np.int32),
    )
