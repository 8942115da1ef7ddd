"""A surface without looks: what fusion makes and texturing dresses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix


@dataclass
class Surface:
    """vertices (V, 3) float64 in scene units; faces (F, 3) int32, counter-clockwise from outside; invented (F,) bool:
    faces that close what no camera saw."""

    vertices: np.ndarray
    faces: np.ndarray
    invented: np.ndarray

    def normals(self) -> np.ndarray:
        """Unit normals of the vertices, (V, 3) float64."""
        return vertex_normals(self.vertices, self.faces)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) float64 unit normals: faces count by their angle at the vertex (Thuermer and Wuethrich 1998).

    (0, 0, 1) where only degenerate faces meet, or none.
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


def neighbours(vertices: np.ndarray, faces: np.ndarray) -> csr_matrix:
    """(V, V): how closely vertices are tied, 1 / length of the edge between them; 0 without one."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.concatenate([edges, edges[:, ::-1]])
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    ties = 1 / np.maximum(length, 1e-3 * max(float(length.mean()), 1e-30))
    return coo_matrix((ties, (edges[:, 0], edges[:, 1])), (len(vertices), len(vertices))).tocsr()


class NoSurface(Exception):
    """There is no surface to be had; the message says in one plain sentence why."""
