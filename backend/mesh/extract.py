"""A signed distance field -> the mesh around it: closed, two-manifold, of the size that was asked for."""

from __future__ import annotations

import manifold3d
import numpy as np
from scipy.spatial import cKDTree

from ..protocol import Reporter
from .fusion import Field, NoSurface, of_size
from .marching import compact, march, parts
from .surface import Surface

FACES = 20_000
"""How many triangles a mesh has at most unless asked otherwise."""


def extract(field: Field, closed: bool = True, faces: int = FACES, reporter: Reporter | None = None) -> Surface:
    """The zero level of `field` with at most `faces` triangles; what closes it unseen is marked as invented.

    Closed, the surface is watertight and two-manifold; otherwise it ends where no camera saw it. Raises NoSurface.
    """
    vertices, triangles, seen = march(field.blocks, field.values, field.seen, closed)
    keep = _worth(vertices, triangles, seen, closed)
    if not keep.any():
        raise NoSurface("The views see too little of it, or do not agree on where it is.")
    seen = seen[keep]
    vertices, triangles = compact(vertices, triangles[keep])
    full = vertices, triangles
    if closed:
        vertices, triangles = _reduced(vertices, triangles, faces)
    invented = ~seen
    if triangles is not full[1]:
        _, nearest = cKDTree(full[0][full[1]].mean(1)).query(vertices[triangles].mean(1))
        invented = ~seen[nearest]
    return Surface(field.origin + field.voxel * vertices, triangles.astype(np.int32), invented)


def _worth(vertices: np.ndarray, faces: np.ndarray, seen: np.ndarray, closed: bool) -> np.ndarray:
    """(F,) bool: faces of parts that are large enough, seen somewhere, and no bubbles inside."""
    keep = of_size(vertices, faces)
    count, part = parts(faces, len(vertices))
    if closed and count:
        a, b, c = (vertices[faces[:, i]] for i in range(3))
        volume = np.bincount(part, (np.cross(a, b) * c).sum(1), count)
        looked_at = np.bincount(part, seen, count)
        keep &= ((volume > 0) & (looked_at > 0))[part]
    return keep


def _reduced(vertices: np.ndarray, faces: np.ndarray, budget: int) -> tuple[np.ndarray, np.ndarray]:
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(np.ascontiguousarray(vertices), np.ascontiguousarray(faces.astype(np.uint64)))
    )
    if solid.status() != manifold3d.Error.NoError:
        raise NoSurface(f"not manifold {solid.status()}")
    tolerance = 0.05
    best = solid
    while best.num_tri() > budget:
        best = solid.simplify(tolerance)
        tolerance *= 1.5
    mesh = best.to_mesh64()
    return np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts).astype(np.int32)
