"""Topology of a mesh: whether it is watertight and manifold, its components and its self-intersections."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

_ROWS_AT_ONCE = 512
_PAIRS_AT_ONCE = 2_000_000
_ROUNDING = 1e-14
"""Volumes up to this fraction of the product of their edges count as 0: the corners are coplanar."""
_TOUCHING = 1e-9
"""Coplanar faces that overlap by less than this fraction of their size count as touching."""


@dataclass(frozen=True)
class Shape:
    """Topology of a mesh.

    Attributes:
        watertight: Each edge has exactly two faces, with opposite directions along it.
        manifold: The mesh is watertight, and the faces around each vertex form a single fan.
        components: Number of connected components.
        self_intersections: Number of faces that intersect or overlap another face.
    """

    watertight: bool
    manifold: bool
    components: int
    self_intersections: int


def shape_of(vertices: np.ndarray, faces: np.ndarray) -> Shape:
    """Compute the topology of a mesh.

    Args:
        vertices: (V, 3).
        faces: (F, 3) indices, F > 0. Faces are connected only through common vertex indices.
    """
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    watertight, fans = _closed(start, end, len(used))
    parts = _groups(start, end, len(used))
    crossing = self_intersecting(np.asarray(vertices, np.float64)[used], faces)
    return Shape(watertight, watertight and fans == len(used), parts, int(crossing.sum()))


def _groups(a: np.ndarray, b: np.ndarray, nodes: int) -> int:
    links = coo_array((np.ones(len(a), bool), (a, b)), (nodes, nodes))
    return int(connected_components(links, directed=False, return_labels=False))


def _closed(start: np.ndarray, end: np.ndarray, vertices: int) -> tuple[bool, int]:
    """Return whether the half-edges (3F,) form opposite pairs, and the number of fans around the vertices (0 if not).

    The half-edges of a face are consecutive.
    """
    along, against = start.astype(np.int64) * vertices + end, end.astype(np.int64) * vertices + start
    order, order_against = np.argsort(along, kind="stable"), np.argsort(against, kind="stable")
    there, back = along[order], against[order_against]
    watertight = bool((there[1:] != there[:-1]).all() and (there == back).all() and (start != end).all())
    if not watertight:
        return False, 0
    # Half-edge h starts at corner h and ends at corner following[h].
    corner = np.arange(len(start))
    following = corner - corner % 3 + (corner + 1) % 3
    here, other = order, order_against
    return True, _groups(here, following[other], len(start))


def self_intersecting(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Find the faces that intersect or overlap another face.

    Faces that share a corner or an edge (by position) count only if they also meet elsewhere. Faces without area do not
    count.

    Args:
        vertices: (V, 3).
        faces: (F, 3) indices.

    Returns:
        (F,) bool.
    """
    found = np.zeros(len(faces), bool)
    if not len(faces):
        return found
    places, same = np.unique(vertices + 0.0, axis=0, return_inverse=True)
    welded = same.reshape(-1)[faces]
    corners = (places - places.mean(0))[welded]
    edges = np.roll(corners, -1, axis=1) - corners
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    flat = area <= _ROUNDING * (edges**2).sum((1, 2))
    kept = np.flatnonzero(~flat)
    corners, welded = corners[kept], welded[kept]
    for i, j in _overlapping_boxes(corners.min(1), corners.max(1)):
        hit = _meet(corners[i], corners[j], welded[i], welded[j])
        found[kept[i[hit]]] = True
        found[kept[j[hit]]] = True
    return found


def _overlapping_boxes(low: np.ndarray, high: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the pairs of overlapping boxes, each pair once, in batches; low, high (n, 3): the boxes' corners."""
    if not len(low):
        return
    axis = int(np.argmax(high.max(0) - low.min(0)))
    order = np.argsort(low[:, axis], kind="stable")
    columns = [(np.ascontiguousarray(low[order, k]), np.ascontiguousarray(high[order, k])) for k in range(3)]
    first, last = columns[axis]
    # The boxes are sorted by their start, so those that overlap a box along this axis directly follow it.
    stop = np.searchsorted(first, last, side="right")
    start = 0
    while start < len(order):
        longest = int(stop[start : start + _ROWS_AT_ONCE].max()) - start
        end = min(start + min(_ROWS_AT_ONCE, max(1, _PAIRS_AT_ONCE // longest)), len(order))
        until = int(stop[start:end].max())
        after = np.arange(start, until)
        meets = (after[None] > np.arange(start, end)[:, None]) & (after[None] < stop[start:end, None])
        for k in {0, 1, 2} - {axis}:
            begins, ends = columns[k]
            meets &= begins[None, start:until] <= ends[start:end, None]
            meets &= ends[None, start:until] >= begins[start:end, None]
        i, j = np.nonzero(meets)
        yield order[i + start], order[j + start]
        start = end


def _volume_sign(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return the side of the plane (a, b, c) on which d lies: -1, 0 or 1; all arguments (n, 3)."""
    ab, ac, ad = b - a, c - a, d - a
    volume = (np.cross(ab, ac) * ad).sum(1)
    size = np.sqrt((ab * ab).sum(1) * (ac * ac).sum(1) * (ad * ad).sum(1))
    return np.where(np.abs(volume) <= _ROUNDING * size, 0, np.sign(volume)).astype(np.int8)


def _sides(plane: np.ndarray, corners: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """Return the sides (n, 3) of the planes of triangles `plane` (n, 3, 3) on which `corners` (n, 3, 3) lie.

    `shared` corners lie in the plane.
    """
    signs = [_volume_sign(plane[:, 0], plane[:, 1], plane[:, 2], corners[:, k]) for k in range(3)]
    return np.where(shared, 0, np.stack(signs, 1))


def _meet(p: np.ndarray, q: np.ndarray, p_names: np.ndarray, q_names: np.ndarray) -> np.ndarray:
    """Return whether pairs of triangles p, q (n, 3, 3) meet elsewhere than in shared corners and edges.

    p_names, q_names (n, 3): indices of the corners; equal indices mean equal corners.
    """
    equal = p_names[:, :, None] == q_names[:, None, :]
    p_shared, q_shared = equal.any(2), equal.any(1)
    q_sides = _sides(p, q, q_shared)
    apart = (q_sides > 0).all(1) | (q_sides < 0).all(1)
    # Neighbors along an edge whose third corner is off the plane do not overlap.
    apart |= (p_shared.sum(1) == 2) & (q_sides != 0).any(1)
    out = np.zeros(len(p), bool)
    at = np.flatnonzero(~apart)
    p, q, p_shared, q_shared, q_sides = p[at], q[at], p_shared[at], q_shared[at], q_sides[at]
    p_sides = _sides(q, p, p_shared)
    hit = np.zeros(len(at), bool)
    for corners, sides, shared, other in ((p, p_sides, p_shared, q), (q, q_sides, q_shared, p)):
        for k in range(3):
            n = (k + 1) % 3
            crossing = np.flatnonzero((sides[:, k] * sides[:, n] < 0) & ~shared[:, k] & ~shared[:, n] & ~hit)
            hit[crossing[_pierces(corners[crossing, k], corners[crossing, n], other[crossing])]] = True
    level = np.flatnonzero((p_sides == 0).all(1) & (q_sides == 0).all(1))
    hit[level[_overlap(p[level], q[level])]] = True
    out[at[hit]] = True
    return out


def _pierces(start: np.ndarray, end: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Return whether segments `start` to `end` (n, 3) that cross the triangles' planes pass through the triangles."""
    signs = [_volume_sign(start, end, triangle[:, k], triangle[:, (k + 1) % 3]) for k in range(3)]
    turns = np.stack(signs, 1)
    return np.asarray((turns >= 0).all(1) | (turns <= 0).all(1))


def _overlap(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return whether pairs of coplanar triangles (n, 3, 3) overlap, not only touch."""
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    size = np.abs(np.concatenate([p, q], 1) - p[:, :1]).max((1, 2))
    overlap = np.ones(len(p), bool)
    for corners in (p, q):
        for k in range(3):
            axis = np.cross(normal, corners[:, (k + 1) % 3] - corners[:, k])
            axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-300)
            along_p, along_q = (p * axis[:, None]).sum(2), (q * axis[:, None]).sum(2)
            gap = np.maximum(along_q.min(1) - along_p.max(1), along_p.min(1) - along_q.max(1))
            overlap &= gap < -_TOUCHING * size
    return overlap
