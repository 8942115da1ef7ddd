"""Labeled points as PLY, with a 32-bit `object_id`, and double coordinates since captures may be georeferenced."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..capture import Points
from ..shared.errors import InputError
from ..shared.formats.ply import read_vertices, vertex_header, write_vertices
from .voting import Votes

_VERTEX = np.dtype(
    [
        *((axis, "<f8") for axis in "xyz"),
        *((color, "u1") for color in ("red", "green", "blue")),
        *(("object_id", "<u4"), ("margin", "<f4"), ("votes", "<u4")),
    ]
)


@dataclass(frozen=True)
class LabeledPoints:
    """Points with their objects.

    xyz: (M, 3) float64, world. rgb: (M, 3) uint8. ids: (M,) int64, object of each point, 0 for none. margins: (M,)
    float32 in [0, 1], as in `Votes`. visible: (M,) int32, number of views that voted.
    """

    xyz: np.ndarray
    rgb: np.ndarray
    ids: np.ndarray
    margins: np.ndarray
    visible: np.ndarray


def write_points(path: Path, points: Points, votes: Votes) -> None:
    """Write labeled points, atomically.

    Args:
        path: The PLY file.
        points: M points.
        votes: Their labels.
    """
    vertices = np.empty(len(points.xyz), _VERTEX)
    for i, names in enumerate(zip("xyz", ("red", "green", "blue"))):
        vertices[names[0]], vertices[names[1]] = points.xyz[:, i], points.rgb[:, i]
    vertices["object_id"], vertices["margin"], vertices["votes"] = votes.ids, votes.margins, votes.visible
    write_vertices(path, vertices)


def read_points(path: Path) -> LabeledPoints:
    """Read labeled points.

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
    return LabeledPoints(
        np.stack([vertices[axis] for axis in "xyz"], 1),
        np.stack([vertices[color] for color in ("red", "green", "blue")], 1),
        vertices["object_id"].astype(np.int64),
        vertices["margin"].copy(),
        vertices["votes"].astype(np.int32),
    )
