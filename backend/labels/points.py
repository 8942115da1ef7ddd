"""The labelled point cloud as PLY: double coordinates (captures may be georeferenced) and a 32-bit `object_id`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..capture import Points
from ..ply import read_vertices, vertex_header, write_vertices
from ..protocol import InputError
from .voting import Votes

_VERTEX = np.dtype(
    [
        *((axis, "<f8") for axis in "xyz"),
        *((colour, "u1") for colour in ("red", "green", "blue")),
        *(("object_id", "<u4"), ("margin", "<f4"), ("votes", "<u4")),
    ]
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


def write_points(path: Path, points: Points, votes: Votes) -> None:
    """Write the points with their labels to `path`, atomically."""
    vertices = np.empty(len(points.xyz), _VERTEX)
    for i, names in enumerate(zip("xyz", ("red", "green", "blue"))):
        vertices[names[0]], vertices[names[1]] = points.xyz[:, i], points.rgb[:, i]
    vertices["object_id"], vertices["margin"], vertices["votes"] = votes.ids, votes.margins, votes.visible
    write_vertices(path, vertices)


def read_points(path: Path) -> LabelledPoints:
    """Read what `write_points` wrote; raises InputError that names the file when it is anything else."""
    if not path.exists():
        raise InputError(f"{path} does not exist; run the vote first.")
    vertices = read_vertices(path)
    whole = len(vertex_header(_VERTEX, len(vertices))) + len(vertices) * _VERTEX.itemsize
    if vertices.dtype != _VERTEX or path.stat().st_size != whole:
        raise InputError(f"{path} is not a labelled point cloud of this program; run the vote again.")
    return LabelledPoints(
        np.stack([vertices[axis] for axis in "xyz"], 1),
        np.stack([vertices[colour] for colour in ("red", "green", "blue")], 1),
        vertices["object_id"].astype(np.int64),
        vertices["margin"].copy(),
        vertices["votes"].astype(np.int32),
    )
