"""Filling of holes that occluding objects leave in a flat surface, such as a cup on a table.

The winding number cannot fill them, since an open sheet has no inside. Therefore each hole is covered with a patch of
the thickness of the sheet.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from skimage.draw import polygon2mask

from .blocks import LOCAL, SIDE

_FACING = 0.6
"""Smallest cosine between the normals of the surface around a hole and the normal of the hole's plane."""
_FLATNESS = 0.15
"""Largest deviation of a hole's rim from its plane, as a fraction of the hole's size."""
_SMALLEST = 6
_LARGEST = 400
"""Smallest number of edges of a hole's rim, and largest number of voxels across a hole."""
_RIM = 100
"""Approximate number of rim points from which the height of a patch is interpolated."""


class Patches:
    """Patches over the holes in a surface with vertices in voxels.

    Attributes:
        points: (n, 3), one for each voxel.
        normals: (n, 3), outward.
        faces: (m, 3), triangles of the points, for the winding number.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        grids = [found for loop in _loops(faces) if (found := _patch(vertices[loop[0]], vertices, faces[loop[1]]))]
        self.points = np.concatenate([np.zeros((0, 3)), *(points for points, _, _ in grids)])
        self.normals = np.concatenate([np.zeros((0, 3)), *(normals for _, normals, _ in grids)])
        counts = np.cumsum([0, *(len(points) for points, _, _ in grids)])
        triangles = [faces + first for (_, _, faces), first in zip(grids, counts)]
        self.faces = np.concatenate([np.zeros((0, 3), np.int64), *triangles])
        self._tree = cKDTree(self.points) if len(self.points) else None

    def thicken(self, coords: np.ndarray, wanted: np.ndarray, thickness: float, values: np.ndarray) -> None:
        """Merge the patches, with a thickness in voxels, into `values` (B, 512) of the blocks `coords` where `wanted`.

        Samples up to `thickness` below a patch become negative.
        """
        if self._tree is None or not len(coords):
            return
        away, _ = self._tree.query(coords * SIDE + 0.5 * (SIDE - 1), distance_upper_bound=SIDE + thickness)
        for b in np.flatnonzero(np.isfinite(away)):
            place = np.flatnonzero(wanted[b])
            samples = coords[b] * SIDE + LOCAL[place]
            off, nearest = self._tree.query(samples)
            across = samples - self.points[nearest]
            height = (across * self.normals[nearest]).sum(1)
            beside = np.sqrt(np.maximum(off**2 - height**2, 0)) - 1
            slab = np.maximum(np.maximum(height, -height - thickness), beside)
            values[b, place] = np.minimum(values[b, place], slab)


def rim_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges (3 F, 2) of faces (F, 3), each in its face's direction, and the indices of those at the rim."""
    edges = np.stack([faces, np.roll(faces, -1, 1)], -1).reshape(-1, 2).astype(np.int64)
    size = int(faces.max(initial=0)) + 1
    there, back = edges[:, 0] * size + edges[:, 1], edges[:, 1] * size + edges[:, 0]
    return edges, np.flatnonzero(~np.isin(there, back))


def _loops(faces: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Find the boundary loops of a surface: the vertices in the direction of the faces, and the face of each edge."""
    edges, rim = rim_edges(faces)
    after: dict[int, list[int]] = {}
    for edge in rim.tolist():
        after.setdefault(int(edges[edge, 0]), []).append(edge)
    loops = []
    while after:
        start: int = next(iter(after))
        at = start
        walked: list[int] = []
        while at in after:
            edge = after[at].pop()
            if not after[at]:
                del after[at]
            walked.append(edge)
            at = int(edges[edge, 1])
        if at == start and len(walked) >= _SMALLEST:
            loops.append((edges[walked, 0], np.array(walked) // 3))
    return loops


def _patch(
    rim: np.ndarray, vertices: np.ndarray, beside: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:  # fmt: skip
    """Return points, normals and triangles over the hole within `rim` (n, 3); None if the surface is not flat there."""
    center = rim.mean(0)
    normal = np.cross(rim - center, np.roll(rim, -1, 0) - center).sum(0) / 2
    area = float(np.linalg.norm(normal))
    a, b, c = (vertices[beside[:, i]] for i in range(3))
    around = np.cross(b - a, c - a)
    around /= np.maximum(np.linalg.norm(around, axis=1, keepdims=True), 1e-12)
    # The loop around a hole has the opposite orientation of the surface's outline.
    normal /= -max(area, 1e-12)
    heights = (rim - center) @ normal
    if area < 1 or (around.mean(0) * normal).sum() < _FACING or heights.std() > _FLATNESS * np.sqrt(area):
        return None
    u = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    u /= np.linalg.norm(u)
    v = np.cross(normal, u)
    flat = np.stack([(rim - center) @ u, (rim - center) @ v], 1)
    low = np.floor(flat.min(0)) - 1
    shape = np.ceil(flat.max(0) - low).astype(int) + 2
    if shape.max() > _LARGEST:
        return None
    inside = polygon2mask(tuple(shape), flat - low)
    number = np.cumsum(inside).reshape(inside.shape) - 1
    place = np.argwhere(inside) + low
    if not len(place):
        return None
    some = slice(None, None, max(len(rim) // _RIM, 1))
    closeness = 1 / (((place[:, None] - flat[some]) ** 2).sum(2) + 0.25)
    height = closeness @ heights[some] / closeness.sum(1)
    points = center + place[:, :1] * u + place[:, 1:] * v + height[:, None] * normal
    whole = inside[:-1, :-1] & inside[1:, :-1] & inside[:-1, 1:] & inside[1:, 1:]
    i, j = np.nonzero(whole)
    corners = number[i, j], number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]
    faces = np.concatenate([np.stack(corners[:3], 1), np.stack([corners[0], corners[2], corners[3]], 1)])
    return points, np.broadcast_to(normal, points.shape), faces
