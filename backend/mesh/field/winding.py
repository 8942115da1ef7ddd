"""Generalized winding number of an open surface (Jacobson et al. 2013).

It is 1 inside a closed surface and 0 outside. Across holes it changes smoothly, with 1/2 on the plane of a flat hole.
It is approximated by dipoles, one for each cluster of triangles, with larger clusters at a distance (Barill et al.
2018).
"""

from __future__ import annotations

import numpy as np
from numba import prange

from ...raster.kernel import kernel
from .blocks import SIDE, pack

_FINE, _MIDDLE, _COARSE = 2, SIDE, 4 * SIDE
"""Edge lengths of the clusters, in voxels."""


class Winding:
    """The winding number of a triangle mesh, vertices (V, 3) in voxels and faces (F, 3)."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        a, b, c = (vertices[faces[:, i]] for i in range(3))
        centers = (a + b + c) / 3
        normals = np.cross(b - a, c - a) / 2
        keys = [pack(np.floor(centers / side).astype(np.int64)) for side in (_FINE, _MIDDLE, _COARSE)]
        order = np.lexsort(keys)
        centers, normals, keys = centers[order], normals[order], [key[order] for key in keys]
        self.fine, first = _clusters(centers, normals, keys[0])
        self.middle, starts = _clusters(centers, normals, keys[1])
        self.coarse, coarse_starts = _clusters(centers, normals, keys[2])
        # Index of the first fine cluster of each middle cluster, and of the first middle cluster of each coarse one.
        self.fine_of = np.append(np.searchsorted(first, starts), len(first)).astype(np.int64)
        self.middle_of = np.append(np.searchsorted(starts, coarse_starts), len(starts)).astype(np.int64)

    def at(self, coords: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """Evaluate at the samples of the blocks `coords` (B, 3): (B, 512) float32; 0 where not `wanted` (B, 512)."""
        out = np.zeros(wanted.shape, np.float32)
        _evaluate(coords, wanted, self.fine, self.fine_of, self.middle, self.middle_of, self.coarse, out)
        return out


def _clusters(centers: np.ndarray, normals: np.ndarray, keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the center and area-scaled normal (n, 6) of each run of equal keys, and the start of each run."""
    starts = np.flatnonzero(np.append(True, keys[1:] != keys[:-1]))
    areas = np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    weighted = np.add.reduceat(centers * areas[:, None], starts) / np.add.reduceat(areas, starts)[:, None]
    return np.concatenate([weighted, np.add.reduceat(normals, starts)], 1), starts


@kernel()
def _dipole(cluster, x, y, z):
    dx, dy, dz = cluster[0] - x, cluster[1] - y, cluster[2] - z
    square = max(dx * dx + dy * dy + dz * dz, 0.5)
    return (cluster[3] * dx + cluster[4] * dy + cluster[5] * dz) / (square * np.sqrt(square))


@kernel(parallel=True)
def _evaluate(coords, wanted, fine, fine_of, middle, middle_of, coarse, out):
    reach = 0.5 * (SIDE - 1) * np.sqrt(3.0)
    far_coarse = (reach + 1.5 * _COARSE) ** 2
    far_middle = (reach + 1.5 * _MIDDLE) ** 2
    scale = 1.0 / (4.0 * np.pi)
    for b in prange(coords.shape[0]):
        needed = False
        for n in range(wanted.shape[1]):
            needed = needed or wanted[b, n]
        if not needed:
            continue
        corner = np.empty(3)
        for i in range(3):
            corner[i] = coords[b, i] * SIDE
        center = corner + 0.5 * (SIDE - 1)
        # Distant clusters are evaluated at the block's corners and interpolated, near ones at each sample.
        far = np.zeros(8)
        near = np.empty(middle.shape[0], np.int64)
        count = 0
        for c in range(coarse.shape[0]):
            square = 0.0
            for i in range(3):
                square += (coarse[c, i] - center[i]) ** 2
            if square > far_coarse:
                for k in range(8):
                    x = corner[0] + (SIDE - 1) * (k >> 2)
                    y = corner[1] + (SIDE - 1) * ((k >> 1) & 1)
                    far[k] += _dipole(coarse[c], x, y, corner[2] + (SIDE - 1) * (k & 1))
                continue
            for m in range(middle_of[c], middle_of[c + 1]):
                square = 0.0
                for i in range(3):
                    square += (middle[m, i] - center[i]) ** 2
                if square > far_middle:
                    for k in range(8):
                        x = corner[0] + (SIDE - 1) * (k >> 2)
                        y = corner[1] + (SIDE - 1) * ((k >> 1) & 1)
                        far[k] += _dipole(middle[m], x, y, corner[2] + (SIDE - 1) * (k & 1))
                else:
                    near[count] = m
                    count += 1
        for n in range(wanted.shape[1]):
            if not wanted[b, n]:
                continue
            i, j, h = n // (SIDE * SIDE), n // SIDE % SIDE, n % SIDE
            value = 0.0
            for k in range(8):
                s = i / (SIDE - 1) if k >> 2 else 1 - i / (SIDE - 1)
                t = j / (SIDE - 1) if (k >> 1) & 1 else 1 - j / (SIDE - 1)
                r = h / (SIDE - 1) if k & 1 else 1 - h / (SIDE - 1)
                value += s * t * r * far[k]
            for q in range(count):
                m = near[q]
                for f in range(fine_of[m], fine_of[m + 1]):
                    value += _dipole(fine[f], corner[0] + i, corner[1] + j, corner[2] + h)
            out[b, n] = value * scale
