"""Rasterization of a mesh with a z-buffer: face, depth and barycentric coordinates of each pixel.

A pixel's ray d intersects the face (P0, P1, P2), in camera space, where d t = b0 P0 + b1 P1 + b2 P2 with weights that
sum to 1. With the edge functions e_i = d . (P_j x P_k), b_i = e_i / sum(e) and t = det / sum(e). There is no division
by the depth of a vertex, so faces that extend behind the camera need no clipping.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from ...raster.camera import Camera
from ...raster.kernel import kernel

_BAND = 16
"""Number of image rows that one thread draws at a time."""

_DET, _NEAREST, _FARTHEST = 9, 10, 11
_COLUMNS = 12
"""Number of columns of a prepared face: the coefficients of (x, y, 1) of three edge functions, then these three."""


def draw_mesh(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rasterize both sides of a mesh.

    Of faces at the same depth, the first is drawn. Faces that have no area, are edge-on or have non-finite corners are
    not drawn.

    Args:
        vertices: (V, 3) in the units of the camera's world.
        faces: (F, 3) indices.
        camera: The camera with H rows and W columns.

    Returns:
        depth (H, W) float32 along the camera's z, 0 where nothing is drawn; face (H, W) int32, -1 where nothing is
        drawn; barycentric (H, W, 3) float32, perspective-correct weights of the face's corners.
    """
    viewmat, intrinsics = camera.arrays()
    seen = np.asarray(vertices, np.float64).reshape(-1, 3) @ viewmat[:3, :3].T + viewmat[:3, 3]
    corners = np.ascontiguousarray(faces, np.int32).reshape(-1, 3)
    prepared = np.empty((len(corners), _COLUMNS))
    boxes = np.empty((len(corners), 4), np.int32)
    _prepare(seen, corners, intrinsics, camera.width, camera.height, float(camera.near), prepared, boxes)
    starts, members = _bin(boxes, (camera.height + _BAND - 1) // _BAND)
    depth = np.zeros((camera.height, camera.width), np.float32)
    face = np.full((camera.height, camera.width), -1, np.int32)
    barycentric = np.zeros((camera.height, camera.width, 3), np.float32)
    _fill(prepared, boxes, starts, members, float(camera.near), depth, face, barycentric)
    return depth, face, barycentric


@kernel(parallel=True)
def _prepare(seen, corners, intrinsics, width, height, near, prepared, boxes):
    """Compute edge functions and pixel boxes (first column, last + 1, first row, last + 1; empty if not drawn)."""
    fx, fy, cx, cy = intrinsics
    for f in prange(corners.shape[0]):
        boxes[f] = 0
        nearest, farthest = np.inf, -np.inf
        left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
        finite = True
        for i in range(3):
            p = corners[f, i]
            q = corners[f, (i + 1) % 3]
            for axis in range(3):
                finite = finite and np.isfinite(seen[p, axis])
            z, z_next = seen[p, 2], seen[q, 2]
            nearest = min(nearest, z)
            farthest = max(farthest, z)
            if z >= near:
                x = seen[p, 0] / z * fx + cx
                y = seen[p, 1] / z * fy + cy
                left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
            if (z >= near) != (z_next >= near):
                share = (near - z) / (z_next - z)
                x = (seen[p, 0] + share * (seen[q, 0] - seen[p, 0])) / near * fx + cx
                y = (seen[p, 1] + share * (seen[q, 1] - seen[p, 1])) / near * fy + cy
                left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
        if not (finite and farthest >= near and left < width and right > 0 and top < height and bottom > 0):
            continue
        det = 0.0
        for i in range(3):
            p = corners[f, (i + 1) % 3]
            q = corners[f, (i + 2) % 3]
            # Exactly the negative of the neighboring face's result for this edge, so that there are no gaps.
            nx = seen[p, 1] * seen[q, 2] - seen[p, 2] * seen[q, 1]
            ny = seen[p, 2] * seen[q, 0] - seen[p, 0] * seen[q, 2]
            nz = seen[p, 0] * seen[q, 1] - seen[p, 1] * seen[q, 0]
            prepared[f, 3 * i] = nx / fx
            prepared[f, 3 * i + 1] = ny / fy
            prepared[f, 3 * i + 2] = nz - (nx / fx * cx + ny / fy * cy)
            if i == 0:
                p = corners[f, 0]
                det = nx * seen[p, 0] + ny * seen[p, 1] + nz * seen[p, 2]
        if det == 0.0:
            continue
        if det < 0.0:
            for i in range(9):
                prepared[f, i] = -prepared[f, i]
        prepared[f, _DET] = abs(det)
        prepared[f, _NEAREST] = max(nearest, near)
        prepared[f, _FARTHEST] = farthest
        # Columns and rows whose centers, at half-integers, lie inside, plus one because of rounding.
        boxes[f, 0] = int(max(np.floor(left - 0.5), 0.0))
        boxes[f, 1] = int(min(np.floor(right - 0.5) + 2.0, width))
        boxes[f, 2] = int(max(np.floor(top - 0.5), 0.0))
        boxes[f, 3] = int(min(np.floor(bottom - 0.5) + 2.0, height))


@kernel()
def _bin(boxes, bands):
    """List the faces in each band of rows, in their original order: starts (bands + 1,), members (n,)."""
    starts = np.zeros(bands + 1, np.int64)
    for f in range(boxes.shape[0]):
        if boxes[f, 0] < boxes[f, 1] and boxes[f, 2] < boxes[f, 3]:
            for band in range(boxes[f, 2] // _BAND, (boxes[f, 3] - 1) // _BAND + 1):
                starts[band + 1] += 1
    starts = np.cumsum(starts)
    at = starts[:-1].copy()
    members = np.empty(starts[-1], np.int32)
    for f in range(boxes.shape[0]):
        if boxes[f, 0] < boxes[f, 1] and boxes[f, 2] < boxes[f, 3]:
            for band in range(boxes[f, 2] // _BAND, (boxes[f, 3] - 1) // _BAND + 1):
                members[at[band]] = f
                at[band] += 1
    return starts, members


@kernel(parallel=True)
def _fill(prepared, boxes, starts, members, near, depth, face, barycentric):
    height, width = depth.shape
    for band in prange(starts.size - 1):
        row_stop = min((band + 1) * _BAND, height)
        for member in range(starts[band], starts[band + 1]):
            f = members[member]
            e = prepared[f]
            for row in range(max(boxes[f, 2], band * _BAND), min(boxes[f, 3], row_stop)):
                y = row + 0.5
                r0 = e[1] * y + e[2]
                r1 = e[4] * y + e[5]
                r2 = e[7] * y + e[8]
                for column in range(boxes[f, 0], boxes[f, 1]):
                    x = column + 0.5
                    e0 = e[0] * x + r0
                    e1 = e[3] * x + r1
                    e2 = e[6] * x + r2
                    total = e0 + e1 + e2
                    if e0 < 0.0 or e1 < 0.0 or e2 < 0.0 or total <= 0.0 or e[_DET] < near * total:
                        continue
                    # Rounding can move the depth of nearly edge-on faces out of the face's range.
                    z = np.float32(min(max(e[_DET] / total, e[_NEAREST]), e[_FARTHEST]))
                    if face[row, column] < 0 or z < depth[row, column]:
                        depth[row, column] = z
                        face[row, column] = f
        for row in range(band * _BAND, row_stop):
            for column in range(width):
                f = face[row, column]
                if f >= 0:
                    total = 0.0
                    for i in range(3):
                        x, y = column + 0.5, row + 0.5
                        total += prepared[f, 3 * i] * x + (prepared[f, 3 * i + 1] * y + prepared[f, 3 * i + 2])
                    for i in range(3):
                        x, y = column + 0.5, row + 0.5
                        weight = prepared[f, 3 * i] * x + (prepared[f, 3 * i + 1] * y + prepared[f, 3 * i + 2])
                        barycentric[row, column, i] = weight / total
