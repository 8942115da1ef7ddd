"""An untextured triangle mesh, the result of fusion and the input of texturing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix

_TURN = 0.5
"""Cosine of the largest angle by which a face may rotate where vertices move."""
_UNFOLDED = 40
"""Largest number of rounds in which displacements are smoothed where faces rotate more."""


@dataclass
class Surface:
    """A triangle mesh.

    Attributes:
        vertices: (V, 3) float64 in scene units.
        faces: (F, 3) int32, counter-clockwise from outside.
        unobserved: (F,) bool, faces that close the mesh where no camera observed the object.
    """

    vertices: np.ndarray
    faces: np.ndarray
    unobserved: np.ndarray

    def normals(self) -> np.ndarray:
        """Return the unit normals of the vertices, (V, 3) float64."""
        return vertex_normals(self.vertices, self.faces)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Compute vertex normals, weighted by the faces' angles at the vertex (Thuermer and Wuethrich 1998).

    Args:
        vertices: (V, 3).
        faces: (F, 3) indices, counter-clockwise from outside.

    Returns:
        (V, 3) float64 unit normals; (0, 0, 1) for vertices without a face that has an area.
    """
    corners = vertices[faces]
    ahead = np.roll(corners, -1, 1) - corners
    ahead /= np.maximum(np.linalg.norm(ahead, axis=2, keepdims=True), 1e-300)
    behind = -np.roll(ahead, 1, 1)
    angles = np.arccos(np.clip((ahead * behind).sum(2), -1, 1))
    across = np.cross(ahead[:, 0], behind[:, 0])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
    weighted = angles[:, :, None] * across[:, None]
    at, count = faces.ravel(), len(vertices)
    sums = np.stack([np.bincount(at, weighted[:, :, i].ravel(), count) for i in range(3)], 1)
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.where(length > 1e-9, sums / np.maximum(length, 1e-9), [0.0, 0.0, 1.0])


def neighbors(vertices: np.ndarray, faces: np.ndarray) -> csr_matrix:
    """Return the weighted adjacency matrix (V, V): 1 / length of the edge between two vertices, 0 if there is none."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.concatenate([edges, edges[:, ::-1]])
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    ties = 1 / np.maximum(length, 1e-3 * max(float(length.mean()), 1e-30))
    return coo_matrix((ties, (edges[:, 0], edges[:, 1])), (len(vertices), len(vertices))).tocsr()


def without_folds(vertices: np.ndarray, faces: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """Return `displacement` (V, 3) of the vertices (V, 3), smoothed where faces (F, 3) would fold over."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    before = np.cross(b - a, c - a)
    even = neighbors(vertices, faces)
    even.data = 1 / np.repeat(np.maximum(np.diff(even.indptr), 1), np.diff(even.indptr))
    for round in range(_UNFOLDED):
        a, b, c = np.moveaxis((vertices + displacement)[faces], 1, 0)
        after = np.cross(b - a, c - a)
        least = _TURN * np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
        folded = (before * after).sum(1) < least
        if not folded.any():
            break
        near = np.zeros(len(vertices))
        near[faces[folded]] = 1
        for _ in range(1 + round // 4):
            near = near + even @ near
        displacement = np.where(near[:, None] > 0, (displacement + even @ displacement) / 2, displacement)
    return displacement


class NoSurface(Exception):
    """Error: no surface can be extracted. The message is a sentence with the reason."""
