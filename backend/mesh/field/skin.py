"""The layer just below an observed surface, which is part of the object even where nothing else tells its inside.

Behind an open sheet, such as a wall or a floor, the winding number is that of the outside. Where few views see the
sheet, it would end.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..surface import vertex_normals
from .blocks import LOCAL, SIDE
from .holes import rim_edges

_BESIDE = 0.7
"""Largest distance in voxels along the surface from its nearest vertex; vertices are about as far apart."""

_EDGE = 1.0
"""Distance in voxels from the edge of the surface within which it is inaccurate, as at the contact with a table. With
larger ones, thin parts that few views see would end, too."""


class Skin:
    """A surface with vertices (V, 3) in voxels and faces (F, 3)."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self._tree, self._vertices = cKDTree(vertices), vertices
        self._normals = vertex_normals(vertices, faces)
        edges, at_rim = rim_edges(faces)
        rim = np.unique(edges[at_rim])
        self._inner = np.ones(len(vertices), bool)
        if len(rim):
            self._inner = cKDTree(vertices[rim]).query(vertices, workers=-1)[0] > _EDGE

    def keep(self, coords: np.ndarray, wanted: np.ndarray, distances: np.ndarray, values: np.ndarray) -> None:
        """Replace `values` (B, 512) of samples straight below the surface by `distances`, in place.

        Args:
            coords: (B, 3) the blocks.
            wanted: (B, 512) bool, the samples that may be replaced.
            distances: (B, 512) signed distances.
            values: (B, 512) signed distances to replace.
        """
        block, place = np.nonzero(wanted)
        samples = coords[block] * SIDE + LOCAL[place]
        away, nearest = self._tree.query(samples, workers=-1)
        height = ((samples - self._vertices[nearest]) * self._normals[nearest]).sum(1)
        below = self._inner[nearest] & (height < 0) & (away**2 - height**2 < _BESIDE**2)
        values[block[below], place[below]] = distances[block[below], place[below]]
