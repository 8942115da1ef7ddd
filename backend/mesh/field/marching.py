"""Triangulation of the zero level of a sparse field: scikit-image's marching cubes on dense cubes of 64 cells per side.

Neighboring cubes share a layer of samples, so they have identical vertices there, which are merged. Only one dense cube
at a time is in memory.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from ...raster.kernel import kernel
from .blocks import SIDE, Blocks, distinct

_BLOCKS = 8
_CELLS = _BLOCKS * SIDE


def march(
    blocks: Blocks, values: np.ndarray, seen: np.ndarray, closed: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangulate the zero level of a field.

    Args:
        blocks: The B blocks of the field.
        values: (B, 512) distances, negative inside.
        seen: (B, 512) bool. A cell is seen if all its samples are.
        closed: Whether to triangulate all cells instead of only the seen ones.

    Returns:
        vertices (V, 3) float64 in voxels, faces (F, 3) int32, counter-clockwise from outside, and seen (F,) bool.
    """
    volume = np.empty((_CELLS + 1,) * 3, np.float32)
    state = np.empty((_CELLS + 1,) * 3, np.uint8)
    cells = np.empty((_CELLS + 1,) * 3, np.uint8)
    all_vertices, all_faces, all_seen = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], [np.zeros(0, bool)]
    count = 0
    # A block belongs to its own cube, and its first layers also to the preceding cubes.
    reach = np.stack(np.meshgrid(*[np.arange(_BLOCKS + 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
    for cube in distinct(blocks.coords // _BLOCKS):
        found = blocks.find(cube * _BLOCKS + reach)
        here = found >= 0
        state[:] = 0
        crossed = _fill(values, seen, found[here], reach[here], volume, state, cells, closed)
        if not crossed:
            continue
        # scikit-image reads a cell's mask at its last corner.
        vertices, faces, _, _ = marching_cubes(volume, 0.0, mask=cells > 0, allow_degenerate=True)
        # Due to rounding, the center of a face of the last cells may lie in the cube's border.
        center = np.minimum(np.floor(vertices[faces].mean(1)).astype(np.int64), _CELLS - 1) + 1
        all_seen.append(cells[center[:, 0], center[:, 1], center[:, 2]] == 2)
        all_vertices.append(vertices.astype(np.float64) + cube * _CELLS)
        all_faces.append(faces.astype(np.int64) + count)
        count += len(vertices)
    vertices, faces = np.concatenate(all_vertices), np.concatenate(all_faces)
    vertices, faces = _merged(vertices, faces)
    return vertices, faces.astype(np.int32), np.concatenate(all_seen)


@kernel()
def _fill(values, seen, found, place, volume, state, cells, closed):
    """Copy blocks into the dense cube and set `cells` to 0 (not triangulated), 1 (not entirely seen) or 2 (seen).

    Returns whether any cell is triangulated.
    """
    size = volume.shape[0]
    volume[:] = 1.0
    cells[:] = 0
    for k in range(found.size):
        b = found[k]
        x0, y0, z0 = place[k, 0] * SIDE, place[k, 1] * SIDE, place[k, 2] * SIDE
        for i in range(min(SIDE, size - x0)):
            for j in range(min(SIDE, size - y0)):
                for h in range(min(SIDE, size - z0)):
                    n = (i * SIDE + j) * SIDE + h
                    volume[x0 + i, y0 + j, z0 + h] = values[b, n]
                    state[x0 + i, y0 + j, z0 + h] = 2 if seen[b, n] else 1
    crossed = False
    for k in range(found.size):
        x0, y0, z0 = place[k, 0] * SIDE, place[k, 1] * SIDE, place[k, 2] * SIDE
        for x in range(x0, min(x0 + SIDE, size - 1)):
            for y in range(y0, min(y0 + SIDE, size - 1)):
                for z in range(z0, min(z0 + SIDE, size - 1)):
                    least = 2
                    inside = 0
                    for c in range(8):
                        i, j, h = x + (c >> 2), y + ((c >> 1) & 1), z + (c & 1)
                        least = min(least, state[i, j, h])
                        inside += volume[i, j, h] < 0
                    if inside == 0 or inside == 8 or (least < 2 and not closed):
                        continue
                    cells[x + 1, y + 1, z + 1] = least
                    crossed = crossed or least > 0
    return crossed


def _merged(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge the vertices on the same edge of the grid."""
    nearest = np.round(vertices)
    off = np.abs(vertices - nearest)
    axis = off.argmax(1)
    rows = np.arange(len(vertices))
    off[rows, axis] = 0
    base = nearest.astype(np.int64)
    base[rows, axis] = np.floor(vertices[rows, axis]).astype(np.int64)
    # Ambiguous cells have a vertex in their center instead of on an edge.
    on_edge = off.max(1, initial=0) < 1e-3
    half = 1 << 19
    keys = (((base[:, 0] + half) << 42) | ((base[:, 1] + half) << 22) | ((base[:, 2] + half) << 2)) + axis
    keys = np.where(on_edge, keys, -1 - rows)
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return vertices[first], inverse[faces]


def parts(faces: np.ndarray, vertices: int) -> tuple[int, np.ndarray]:
    """Return the number of connected components, and the component of each face (F,)."""
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_matrix((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), (vertices, vertices))
    _, of_vertex = connected_components(graph, directed=False)
    used, of_face = np.unique(of_vertex[faces[:, 0]], return_inverse=True)
    return len(used), of_face


def compact(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Remove the vertices that no face uses."""
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    return vertices[used], (np.cumsum(used) - 1)[faces].astype(np.int32)
