"""A surface laid out flat: each face's corners get a place in a square picture."""

from __future__ import annotations

import numpy as np
import xatlas
from scipy.sparse import coo_matrix, diags

from .surface import Surface

_PACKED_AT = 1024
"""Texels across in which charts are packed; the layout is the same for every size of the picture."""

_PADDING = 4
"""Texels of the picture between charts, at least."""

_LARGEST_CHART = 20000
"""Faces in a chart, about; the time grows with their square."""

_SMOOTHED_FROM = 500
"""Faces from which on the charts are found on a smoothed copy."""

_ROUNDS = 10
_SHRINK, _SWELL = 0.5, -0.53


def unwrap(surface: Surface, texture_size: int) -> np.ndarray:
    """UVs of each face's corners, (F, 3, 2) float32 in 0..1, (0, 0) at the picture's lower left.

    texture_size: the picture's width and height, which the distance between charts suits. Areas in the picture are
    nearly proportional to areas on the surface. Faces without area become points.
    """
    vertices = np.asarray(surface.vertices, np.float64)
    faces = np.ascontiguousarray(surface.faces, np.uint32)
    if not len(faces):
        return np.zeros((0, 3, 2), np.float32)
    if len(faces) >= _SMOOTHED_FROM:
        vertices = _smoothed(vertices, surface.faces)
    low = vertices.min(0)
    vertices = (vertices - low) / max(float((vertices.max(0) - low).max()), 1e-30)
    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices.astype(np.float32), faces)
    charts = xatlas.ChartOptions()
    # Fewer terms to weigh: less than half of the time, and charts as large.
    charts.max_cost = 4.0
    charts.roundness_weight = charts.straightness_weight = 0.0
    charts.normal_seam_weight = charts.texture_seam_weight = 0.0
    charts.fix_winding = True
    if len(faces) > _LARGEST_CHART:
        a, b, c = np.moveaxis(vertices[surface.faces], 1, 0)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
        charts.max_chart_area = float(area) * _LARGEST_CHART / len(faces)
    packing = xatlas.PackOptions()
    packing.resolution = _PACKED_AT
    packing.padding = max(1, -(-_PADDING * _PACKED_AT // texture_size))
    packing.bilinear = True
    packing.rotate_charts = False  # It transposes them, which mirrors.
    atlas.generate(charts, packing)
    origin, corners, uvs = atlas[0]
    # A length is as many texels across as up: xatlas gives shares of the width and of the height.
    uvs = np.nan_to_num(np.asarray(uvs, np.float64)) * [atlas.width, atlas.height] / max(atlas.width, atlas.height, 1)
    return _with_points(uvs, np.asarray(origin, np.int64), np.asarray(corners, np.int64)).astype(np.float32)


def _with_points(uvs: np.ndarray, origin: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(F, 3, 2): faces that are in no chart, at (0, 0), become a point where another face has one of their corners."""
    placed = (uvs != 0).any(1)
    known = np.zeros((origin.max() + 1, 2))
    known[origin[placed]] = uvs[placed]
    out = uvs[corners]
    lost = ~placed[corners].all(1)
    points = known[origin[corners[lost]]]
    first = (points != 0).any(2).argmax(1)
    out[lost] = points[np.arange(len(points)), first][:, None]
    return out


def _smoothed(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The vertices without the roughness (Taubin 1995) that would cut charts to pieces; the shape keeps its size."""
    count = len(vertices)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.concatenate([edges, edges[:, ::-1]])
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    shortest = np.full(count, np.inf)
    np.minimum.at(shortest, edges[:, 0], length)
    # Near vertices count more, so that flat parts with faces of all sizes stay as they are.
    weights = 1 / np.maximum(length, 1e-6 * max(float(length.max()), 1e-30))
    near = coo_matrix((weights, (edges[:, 0], edges[:, 1])), (count, count)).tocsr()
    mean = diags(1 / np.maximum(np.asarray(near.sum(1)).ravel(), 1e-30)) @ near
    moved = vertices
    for step in (_SHRINK, _SWELL) * _ROUNDS:
        moved = moved + step * (mean @ moved - moved)
    way = moved - vertices
    far = np.linalg.norm(way, axis=1)
    return (
        vertices + way * np.minimum(1, np.where(np.isfinite(shortest), shortest, 0) / np.maximum(far, 1e-30))[:, None]
    )
