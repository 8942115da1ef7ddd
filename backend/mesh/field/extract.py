"""Extraction of a watertight, two-manifold triangle mesh of limited size from a signed distance field."""

from __future__ import annotations

import fast_simplification
import manifold3d
import numpy as np
from scipy.sparse import coo_matrix
from scipy.spatial import cKDTree

from ...shared.events import Reporter
from ..surface import NoSurface, Surface
from .fusion import Field, largest_parts, of_size
from .marching import compact, march, parts

FACES = 20_000
"""Default limit of the number of triangles."""

_SMOOTHING = (0.5, -0.53) * 10
_AGGRESSIONS = (7.0, 5.0, 10.0)
"""Growth rates of the decimation's tolerance, tried in turn, since some of them may tear the surface."""


def extract(field: Field, closed: bool = True, faces: int = FACES, reporter: Reporter | None = None) -> Surface:
    """Extract the zero level of a field as a triangle mesh.

    Args:
        field: The signed distance field.
        closed: Whether to return a watertight, two-manifold mesh in which the faces that no camera observed are marked
            as unobserved. Otherwise the mesh ends where no camera observed the object.
        faces: The largest number of triangles, exceeded only where fewer would tear the surface.
        reporter: Receives the progress, and a warning if the surface has more triangles.

    Returns:
        The surface in scene units.

    Raises:
        NoSurface: Too little of the object was observed.
    """
    reporter = reporter or Reporter()
    reporter.progress(0, 3)
    vertices, triangles, seen = march(field.blocks, field.values, field.seen, closed)
    keep = _worth(vertices, triangles, seen, closed)
    if not keep.any():
        raise NoSurface("The views see too little of it, or do not agree on where it is.")
    seen = seen[keep]
    vertices, triangles = compact(vertices, triangles[keep])
    reporter.progress(1, 3)
    vertices = _smoothed(vertices, triangles)
    reporter.progress(1.5, 3)
    full = vertices[triangles].mean(1)
    reduced, triangles = _reduced(vertices, triangles, faces, closed)
    reporter.progress(2.5, 3)
    if len(triangles) > faces:
        reporter.warning(f"The mesh has {len(triangles):,} triangles, more than {faces:,}: fewer would tear it.")
    _, nearest = cKDTree(full).query(reduced[triangles].mean(1))
    return Surface(field.origin + field.voxel * reduced, triangles, ~seen[nearest])


def _worth(vertices: np.ndarray, faces: np.ndarray, seen: np.ndarray, closed: bool) -> np.ndarray:
    """Find the faces of components that are large enough, partly observed and not interior bubbles, (F,) bool.

    A component that encloses empty space is a bubble, except where most of it was observed, as in a room.
    """
    keep = of_size(vertices, faces)
    count, part = parts(faces, len(vertices))
    if closed and count:
        a, b, c = (vertices[faces[:, i]] for i in range(3))
        volume = np.bincount(part, (np.cross(a, b) * c).sum(1), count)
        looked_at = np.bincount(part, seen, count)
        bubble = (volume <= 0) & (2 * looked_at <= np.bincount(part, minlength=count))
        keep &= ((looked_at > 0) & ~bubble)[part]
    return keep


def _smoothed(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Smooth voxel-sized noise with alternating shrinking and inflating Laplacian steps (Taubin 1995)."""
    edges = np.concatenate([faces[:, :2], faces[:, 1:], faces[:, ::2]])
    ends = np.concatenate([edges, edges[:, ::-1]])
    graph = coo_matrix((np.ones(len(ends), np.float32), (ends[:, 0], ends[:, 1])), (len(vertices),) * 2).tocsr()
    graph.data[:] = 1
    neighbors = np.maximum(np.asarray(graph.sum(1)), 1)
    for step in _SMOOTHING:
        vertices = vertices + step * (graph @ vertices / neighbors - vertices)
    return vertices


def _reduced(
    vertices: np.ndarray, faces: np.ndarray, budget: int, closed: bool
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Decimate to at most `budget` faces if possible without tears, otherwise to the fewest faces without tears."""
    best = vertices, faces
    for aggression in _AGGRESSIONS if len(faces) > budget else ():
        points, triangles = fast_simplification.simplify(
            vertices.astype(np.float32), faces, target_count=budget, agg=aggression
        )
        sound = _sound(points, triangles) if closed else (points.astype(np.float64), triangles.astype(np.int32))
        if sound is not None and len(sound[1]) < len(best[1]):
            best = sound
        if len(best[1]) <= budget:
            break
    return best


def _sound(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Split non-manifold edges and vertices; None if the surface does not bound a solid."""
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.uint64))
    )
    if solid.status() != manifold3d.Error.NoError or solid.is_empty():
        return None
    mesh = solid.to_mesh64()
    vertices, faces = np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts).astype(np.int32)
    # Where the decimation pinched the surface, slivers are now separate components.
    vertices, faces = largest_parts(vertices, faces)
    return (vertices, faces) if is_watertight(faces) else None


def is_watertight(faces: np.ndarray) -> bool:
    """Return whether each edge of the faces (F, 3) belongs to exactly two faces, with opposite directions along it."""
    n = int(faces.max(initial=-1)) + 1
    a, b = faces.ravel().astype(np.int64), np.roll(faces, -1, 1).ravel().astype(np.int64)
    there, back = np.sort(a * n + b), np.sort(b * n + a)
    return bool(len(faces)) and bool((there == back).all()) and bool((there[1:] != there[:-1]).all())
