"""A signed distance field -> the mesh around it: closed, two-manifold, of the size that was asked for."""

from __future__ import annotations

import fast_simplification
import manifold3d
import numpy as np
from scipy.spatial import cKDTree

from ..protocol import Reporter
from .fusion import Field, NoSurface, of_size
from .marching import compact, march, parts
from .surface import Surface

FACES = 20_000
"""How many triangles a mesh has at most unless asked otherwise."""

_AGGRESSIONS = (5.0, 7.0, 3.0)
"""How fast the reduction lets its tolerance grow; where one of them tears the surface, another may not."""


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
    """At most `budget` faces where that can be done without tearing the surface, else the fewest that were found."""
    best = vertices, faces
    for aggression in _AGGRESSIONS if len(faces) > budget else ():
        points, triangles = fast_simplification.simplify(
            vertices.astype(np.float32), faces, target_count=budget, agg=aggression
        )
        sound = _sound(points, triangles)
        if sound is not None and len(sound[1]) < len(best[1]):
            best = sound
        if len(best[1]) <= budget:
            break
    return best


def _sound(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """The surface with edges and vertices that more than two sheets share made several; None where it is no solid."""
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.uint64))
    )
    if solid.status() != manifold3d.Error.NoError or solid.is_empty():
        return None
    mesh = solid.to_mesh64()
    vertices, faces = np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts).astype(np.int32)
    return (vertices, faces) if is_watertight(faces) else None


def is_watertight(faces: np.ndarray) -> bool:
    """Whether each edge belongs to two faces (F, 3) and is walked once in each direction."""
    n = int(faces.max(initial=-1)) + 1
    a, b = faces.ravel().astype(np.int64), np.roll(faces, -1, 1).ravel().astype(np.int64)
    there, back = np.sort(a * n + b), np.sort(b * n + a)
    return bool(len(faces)) and bool((there == back).all()) and bool((there[1:] != there[:-1]).all())
