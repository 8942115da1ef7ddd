"""Meshes as binary PLY with normals, vertex colors, UVs of each face's corners and a flag for unobserved faces."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError
from .atomic import atomic_file
from .ply import LONGEST_HEADER
from .regular_file import read_regular
from .splat_ply import FORMER_UNOBSERVED, UNOBSERVED

_VERTEX = np.dtype([("xyz", "<f8", 3), ("normal", "<f4", 3), ("color", "u1", 3)])
_FACE = np.dtype([("corners", "u1"), ("vertices", "<i4", 3), ("values", "u1"), ("uv", "<f4", 6), (UNOBSERVED, "u1")])
_HEADER = """\
ply
format binary_little_endian 1.0
comment TextureFile {texture}
element vertex {vertices}
property double x
property double y
property double z
property float nx
property float ny
property float nz
property uchar red
property uchar green
property uchar blue
element face {faces}
property list uchar int vertex_indices
property list uchar float texcoord
property uchar {unobserved}
end_header
"""


def _header(texture: str, vertices: int, faces: int) -> str:
    return _HEADER.format(texture=texture, vertices=vertices, faces=faces, unobserved=UNOBSERVED)


@dataclass
class Mesh:
    """A textured triangle mesh.

    Attributes:
        vertices: (V, 3) float64 in the capture's coordinates.
        normals: (V, 3) float32, unit length, outward.
        colors: (V, 3) uint8 sRGB.
        faces: (F, 3) int32, counterclockwise from outside.
        uvs: (F, 3, 2) float32 for each face's corners; (0, 0) is the lower left of the texture.
        unobserved: (F,) bool, faces that no camera saw.
        texture: file name of the texture beside the mesh's file, or "" if there is none.
    """

    vertices: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    faces: np.ndarray
    uvs: np.ndarray
    unobserved: np.ndarray
    texture: str


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Write `mesh` as PLY, atomically."""
    vertices = np.empty(len(mesh.vertices), _VERTEX)
    vertices["xyz"], vertices["normal"], vertices["color"] = mesh.vertices, mesh.normals, mesh.colors
    faces = np.empty(len(mesh.faces), _FACE)
    faces["corners"], faces["values"] = 3, 6
    faces["vertices"], faces["uv"], faces[UNOBSERVED] = mesh.faces, mesh.uvs.reshape(-1, 6), mesh.unobserved
    header = _header(mesh.texture, len(vertices), len(faces))
    with atomic_file(path) as file:
        file.write(header.encode())
        file.write(vertices.data)
        file.write(faces.data)


def read_mesh(path: Path) -> Mesh:
    """Read a file of `write_mesh`; raise InputError that names the file if it is missing, truncated or different."""
    try:
        data = read_regular(path)
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror or error}).") from error
    end = data.find(b"end_header\n", 0, LONGEST_HEADER) + len(b"end_header\n")
    lines = data[:end].decode("utf-8", "replace").splitlines()
    named = {" ".join(line.split()[:2]): " ".join(line.split()[2:]) for line in lines}
    try:
        counts = int(named["element vertex"]), int(named["element face"])
        texture = named["comment TextureFile"]
    except (KeyError, ValueError):
        counts, texture = (0, 0), ""
    header = "\n".join([*lines, ""]).replace(f"property uchar {FORMER_UNOBSERVED}\n", f"property uchar {UNOBSERVED}\n")
    if header != _header(texture, *counts):
        raise InputError(f"{path} is not a mesh that `python -m backend mesh` wrote; make the meshes again.")
    middle = end + counts[0] * _VERTEX.itemsize
    if len(data) != middle + counts[1] * _FACE.itemsize:
        raise InputError(f"{path} is truncated; make the meshes again.")
    vertices = np.frombuffer(data[end:middle], _VERTEX)
    faces = np.frombuffer(data[middle:], _FACE)
    if counts[1] and not 0 <= faces["vertices"].min() <= faces["vertices"].max() < counts[0]:
        raise InputError(f"{path} has faces with invalid vertex indices; make the meshes again.")
    return Mesh(
        vertices["xyz"].copy(), vertices["normal"].copy(), vertices["color"].copy(), faces["vertices"].copy(),
        faces["uv"].reshape(-1, 3, 2).copy(), faces[UNOBSERVED].astype(bool), texture,
    )  # fmt: skip
