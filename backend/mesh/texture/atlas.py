"""Texels of a texture: the surface point of each texel, and filling of texels without one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange

from ...raster.kernel import kernel

_BAND = 16
_RIM = np.float32(1.0)
"""Width in texels of the border of a chart, which is read by bilinear sampling."""


class Texels(NamedTuple):
    """The texels of some rows that lie on a surface.

    Attributes:
        indices: (N,) int64, row-major index in the whole texture.
        face: (N,) int32.
        weights: (N, 3) float32, barycentric weights of the face's corners, which sum to 1 and may be negative in the
            border of a chart.
    """

    indices: np.ndarray
    face: np.ndarray
    weights: np.ndarray


def find_texels(uvs: np.ndarray, size: int, first_row: int, rows: int) -> Texels:
    """Find the texels of `rows` rows from `first_row` on, counted from the top, of a texture of size x size.

    uvs (F, 3, 2): UVs of the faces' corners, (0, 0) at the texture's lower left.
    """
    corners = np.asarray(uvs, np.float64) * size
    corners[..., 1] = size - corners[..., 1] - first_row
    low, high = corners.min(1)[:, 1] - 1.5, corners.max(1)[:, 1] + 1.5
    candidates = np.flatnonzero((high > 0) & (low < rows))
    face = np.full((rows, size), -1, np.int32)
    weights = np.zeros((rows, size, 3), np.float32)
    _cover(corners, candidates, face, weights)
    inside = np.flatnonzero(face.ravel() >= 0)
    return Texels(inside + first_row * size, face.ravel()[inside], weights.reshape(-1, 3)[inside])


@kernel(parallel=True)
def _cover(corners, candidates, face, weights):
    """Assign each texel the face that contains its center, or otherwise the nearest face within the border."""
    rows, size = face.shape
    for band in prange((rows + _BAND - 1) // _BAND):
        top, stop = band * _BAND, min((band + 1) * _BAND, rows)
        outside = np.full((stop - top, size), np.inf, np.float32)
        edges = np.empty((3, 3))
        for f in candidates:
            low, high = np.inf, -np.inf
            left, right = np.inf, -np.inf
            for i in range(3):
                low, high = min(low, corners[f, i, 1]), max(high, corners[f, i, 1])
                left, right = min(left, corners[f, i, 0]), max(right, corners[f, i, 0])
            if high + 1.5 < top or low - 1.5 > stop:
                continue
            area = 0.0
            shortest = np.inf
            for i in range(3):
                j, k = (i + 1) % 3, (i + 2) % 3
                dx = corners[f, k, 0] - corners[f, j, 0]
                dy = corners[f, k, 1] - corners[f, j, 1]
                edges[i, 0], edges[i, 1] = -dy, dx
                edges[i, 2] = dy * corners[f, j, 0] - dx * corners[f, j, 1]
                shortest = min(shortest, dx * dx + dy * dy)
                if i == 0:
                    area = edges[0, 0] * corners[f, 0, 0] + edges[0, 1] * corners[f, 0, 1] + edges[0, 2]
            if area == 0.0 or shortest == 0.0:
                continue
            first = max(int(np.floor(left - 1.5)), 0)
            last = min(int(np.floor(right + 1.5)) + 1, size)
            for row in range(max(int(np.floor(low - 1.5)), top), min(int(np.floor(high + 1.5)) + 1, stop)):
                for column in range(first, last):
                    distance = np.float32(0.0)
                    total = 0.0
                    for i in range(3):
                        barycentric = (edges[i, 0] * (column + 0.5) + edges[i, 1] * (row + 0.5) + edges[i, 2]) / area
                        if barycentric < 0.0:
                            height = abs(area) / np.sqrt(edges[i, 0] ** 2 + edges[i, 1] ** 2)
                            distance = max(distance, np.float32(-barycentric * height))
                    if distance > _RIM or distance >= outside[row - top, column]:
                        continue
                    outside[row - top, column] = distance
                    face[row, column] = f
                    # Limit the extrapolation of the weights beyond the edges of thin faces.
                    for i in range(3):
                        barycentric = (edges[i, 0] * (column + 0.5) + edges[i, 1] * (row + 0.5) + edges[i, 2]) / area
                        barycentric = max(barycentric, -0.5)
                        weights[row, column, i] = barycentric
                        total += barycentric
                    for i in range(3):
                        weights[row, column, i] /= total


@kernel(parallel=True)
def interpolate(values, faces, face, weights, out):
    """Interpolate vertex values (V, 3) at points on the faces `face` (N,) with `weights` (N, 3); writes out (N, 3)."""
    for n in prange(face.size):
        a, b, c = faces[face[n], 0], faces[face[n], 1], faces[face[n], 2]
        for axis in range(3):
            out[n, axis] = (
                weights[n, 0] * values[a, axis] + weights[n, 1] * values[b, axis] + weights[n, 2] * values[c, axis]
            )


def fill(values: np.ndarray, known: np.ndarray) -> None:
    """Extrapolate the `known` (H, W) texels smoothly to the others, with an image pyramid.

    values: (H, W, C) float32, changed in place; becomes 0 everywhere if nothing is known.
    """
    height, width, _ = values.shape
    if height == width == 1:
        values[~known] = 0
        return
    coarse = np.empty(((height + 1) // 2, (width + 1) // 2, values.shape[2]), np.float32)
    found = np.empty(coarse.shape[:2], np.bool_)
    _halve(values, known, coarse, found)
    fill(coarse, found)
    _spread(coarse, known, values)


@kernel(parallel=True)
def _halve(values, known, coarse, found):
    height, width, channels = values.shape
    for row in prange(coarse.shape[0]):
        for column in range(coarse.shape[1]):
            count = 0
            for c in range(channels):
                coarse[row, column, c] = 0.0
            for y in range(2 * row, min(2 * row + 2, height)):
                for x in range(2 * column, min(2 * column + 2, width)):
                    if known[y, x]:
                        count += 1
                        for c in range(channels):
                            coarse[row, column, c] += values[y, x, c]
            found[row, column] = count > 0
            for c in range(channels):
                coarse[row, column, c] /= max(count, 1)


@kernel(parallel=True)
def _spread(coarse, known, values):
    height, width, channels = values.shape
    for row in prange(height):
        y = (row - 0.5) / 2
        y0 = int(np.floor(y))
        fy = np.float32(y - y0)
        y1 = min(y0 + 1, coarse.shape[0] - 1)
        y0 = max(y0, 0)
        for column in range(width):
            if known[row, column]:
                continue
            x = (column - 0.5) / 2
            x0 = int(np.floor(x))
            fx = np.float32(x - x0)
            x1 = min(x0 + 1, coarse.shape[1] - 1)
            x0 = max(x0, 0)
            for c in range(channels):
                upper = coarse[y0, x0, c] * (1 - fx) + coarse[y0, x1, c] * fx
                lower = coarse[y1, x0, c] * (1 - fx) + coarse[y1, x1, c] * fx
                values[row, column, c] = upper * (1 - fy) + lower * fy
