"""Smoothing of a surface that keeps its edges, by filtering the normals of its faces.

Errors of depth and of poses make flat and evenly curved surfaces bumpy, which shading shows. The normal of each face
becomes the mean of those around it, where these differ little (Zheng, Fu, Au and Tai 2011, "Bilateral Normal Filtering
for Mesh Denoising"), and the vertices follow, toward the planes of their faces (Sun, Rosin, Martin and Langbein 2007,
"Fast and Effective Feature-Preserving Mesh Denoising"). Normals across an edge differ much, so it stays sharp.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_matrix

from .surface import Surface, without_folds

_FILTERED, _MOVED = 8, 10
"""Number of times that the normals are filtered, and that the vertices then move."""
_DIFFERENCE = 0.4
"""Standard deviation of the weight over the distance between two unit normals."""


def smooth(surface: Surface) -> Surface:
    """Remove bumps of the size of a few faces from a surface.

    Args:
        surface: The surface.

    Returns:
        The surface with moved vertices and the same faces.
    """
    if not len(surface.faces):
        return surface
    vertices, faces = surface.vertices, surface.faces
    return replace(surface, vertices=vertices + without_folds(vertices, faces, _displacement(vertices, faces)))


def _displacement(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return how far each vertex moves, (V, 3)."""
    normals = _filtered_normals(vertices, faces)
    moved, count = vertices.copy(), len(vertices)
    for _ in range(_MOVED):
        centers, _, areas = _planes(moved, faces)
        total, weight = np.zeros_like(vertices), np.zeros(count)
        for corner in faces.T:
            along = areas * ((centers - moved[corner]) * normals).sum(1)
            total += _sums(corner, along[:, None] * normals, count)
            weight += np.bincount(corner, areas, count)
        moved += total / np.maximum(weight, 1e-300)[:, None]
    return moved - vertices


def _filtered_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the normals of the faces, (F, 3), each averaged with those of faces up to two edges away."""
    centers, normals, areas = _planes(vertices, faces)
    first, second = _faces_nearby(faces)
    distances = np.linalg.norm(centers[first] - centers[second], axis=1)
    reach = max(float(distances.mean()), 1e-300) if len(distances) else 1.0
    near = areas[second] * np.exp(-0.5 * (distances / reach) ** 2)
    for _ in range(_FILTERED):
        unlike = ((normals[first] - normals[second]) ** 2).sum(1)
        weights = near * np.exp(-0.5 * unlike / _DIFFERENCE**2)
        total = areas[:, None] * normals + _sums(first, weights[:, None] * normals[second], len(faces))
        normals = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
    return normals


def _faces_nearby(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs (n,), (n,) of different faces that share an edge, or of which both share one with a third."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort(edges.T)
    edges, owner = edges[order], owner[order]
    shared = (edges[1:] == edges[:-1]).all(1)
    a, b = owner[:-1][shared], owner[1:][shared]
    beside = coo_matrix((np.ones(2 * len(a), np.int8), (np.r_[a, b], np.r_[b, a])), (len(faces),) * 2).tocsr()
    nearby = (beside + beside @ beside).tocoo()
    other = nearby.row != nearby.col
    return nearby.row[other], nearby.col[other]


def _planes(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centers (F, 3), unit normals (F, 3) and areas (F,) of the faces; normals are 0 where the area is."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    across = np.cross(b - a, c - a)
    length = np.linalg.norm(across, axis=1)
    return (a + b + c) / 3, across / np.maximum(length, 1e-300)[:, None], length / 2


def _sums(at: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Return the sums (count, 3) of the values (n, 3) with each index (n,)."""
    return np.stack([np.bincount(at, values[:, axis], count) for axis in range(3)], 1)
