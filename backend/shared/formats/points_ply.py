"""points.ply: labeled points, with a 32-bit `object_id`, and double coordinates since captures may be georeferenced."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError
from .ply import read_vertices, vertex_header, write_vertices

_AXES = ("x", "y", "z")
_CHANNELS = ("red", "green", "blue")
_VERTEX = np.dtype(
    [
        *((axis, "<f8") for axis in _AXES),
        *((channel, "u1") for channel in _CHANNELS),
        *(("object_id", "<u4"), ("margin", "<f4"), ("votes", "<u4")),
    ]
)
_REQUIRED = {*_AXES, *_CHANNELS, "object_id"}
"""Properties that points need to be shown."""


@dataclass(frozen=True)
class LabeledPoints:
    """M points with their objects.

    Attributes:
        xyz: (M, 3) float64, world.
        rgb: (M, 3) uint8.
        ids: (M,) int64, object of each point, 0 for none.
        margins: (M,) float32 in [0, 1], by how much the votes for the object exceed those for the next one.
        visible: (M,) int32, number of views that voted.
    """

    xyz: np.ndarray
    rgb: np.ndarray
    ids: np.ndarray
    margins: np.ndarray
    visible: np.ndarray


def write_points(path: Path, points: LabeledPoints) -> None:
    """Write labeled points as PLY, atomically."""
    vertices = np.empty(len(points.xyz), _VERTEX)
    for i, (axis, channel) in enumerate(zip(_AXES, _CHANNELS)):
        vertices[axis], vertices[channel] = points.xyz[:, i], points.rgb[:, i]
    vertices["object_id"], vertices["margin"], vertices["votes"] = points.ids, points.margins, points.visible
    write_vertices(path, vertices)


def read_points(path: Path) -> LabeledPoints:
    """Read labeled points that the backend computes with.

    Args:
        path: A PLY file of `write_points`.

    Returns:
        The points.

    Raises:
        InputError: The file does not exist or was not written by `write_points`.
    """
    if not path.exists():
        raise InputError(f"{path} does not exist; run the vote first.")
    vertices = read_vertices(path)
    expected_size = len(vertex_header(_VERTEX, len(vertices))) + len(vertices) * _VERTEX.itemsize
    if vertices.dtype != _VERTEX or path.stat().st_size != expected_size:
        raise InputError(f"{path} is not a labeled point cloud of this program; run the vote again.")
    return _points(vertices)


def read_shown_points(path: Path) -> LabeledPoints:
    """Read labeled points for display: properties may have any order and number type, margins and votes be missing.

    Raises:
        InputError: The file is missing, truncated or ASCII, or lacks required properties.
    """
    vertices = read_vertices(path)
    missing = _REQUIRED - set(vertices.dtype.names or ())
    if missing:
        raise InputError(f"{path} has no property {', '.join(sorted(missing))}; run Import again.")
    return _points(vertices)


def _points(vertices: np.ndarray) -> LabeledPoints:
    def column(name: str, kind: type) -> np.ndarray:
        found = name in (vertices.dtype.names or ())
        return vertices[name].astype(kind) if found else np.zeros(len(vertices), kind)

    return LabeledPoints(
        np.stack([vertices[axis].astype(np.float64) for axis in _AXES], 1),
        np.stack([vertices[channel] for channel in _CHANNELS], 1),
        column("object_id", np.int64),
        column("margin", np.float32),
        column("votes", np.int32),
    )
