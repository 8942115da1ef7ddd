"""UV unwrapping of a surface with xatlas."""

from __future__ import annotations

import numpy as np
import xatlas
from scipy.sparse import coo_matrix, diags

from ..surface import Surface

_PACKED_AT = 1024
"""Resolution at which charts are packed; the layout is similar for all texture sizes."""

_PADDING = 4
"""Smallest distance between charts, in texels of the texture."""

_TOGETHER = 5000
"""Largest number of faces that are unwrapped together, since the time grows quadratically with a chart's faces."""

_SMOOTHED_FROM = 500
"""Smallest number of faces for which charts are computed on a smoothed copy."""

_ROUNDS = 10
_SHRINK, _SWELL = 0.5, -0.53


def unwrap(surface: Surface, texture_size: int) -> np.ndarray:
    """Compute the UVs of a surface.

    Args:
        surface: The surface.
        texture_size: The width and height of the texture, for the distance between charts.

    Returns:
        UVs of the faces' corners, (F, 3, 2) float32, 0 .. 1, (0, 0) at the texture's lower left. Areas in the texture
        are nearly proportional to areas on the surface. Faces without area become points.
    """
    vertices = np.asarray(surface.vertices, np.float64)
    faces = np.ascontiguousarray(surface.faces, np.int32)
    if not len(faces):
        return np.zeros((0, 3, 2), np.float32)
    if len(faces) >= _SMOOTHED_FROM:
        vertices = _smoothed(vertices, surface.faces)
    low = vertices.min(0)
    vertices = (vertices - low) / max(float((vertices.max(0) - low).max()), 1e-30)
    atlas = xatlas.Atlas()
    parts = _parts(vertices[surface.faces].mean(1), np.arange(len(faces)))
    members = [np.unique(faces[part], return_inverse=True) for part in parts]
    for used, corners in members:
        atlas.add_mesh(vertices[used].astype(np.float32), corners.reshape(-1, 3).astype(np.uint32))
    charts = xatlas.ChartOptions()
    # Without these cost terms, it takes less than half of the time, with charts of the same size.
    charts.max_cost = 4.0
    charts.roundness_weight = charts.straightness_weight = 0.0
    charts.normal_seam_weight = charts.texture_seam_weight = 0.0
    charts.fix_winding = True
    packing = xatlas.PackOptions()
    packing.resolution = _PACKED_AT
    packing.padding = max(1, -(-_PADDING * _PACKED_AT // texture_size))
    packing.bilinear = True
    packing.rotate_charts = False  # Rotation would transpose, and thus mirror, charts.
    atlas.generate(charts, packing)
    out = np.empty((len(faces), 3, 2), np.float32)
    for k, part in enumerate(parts):
        origin, corners, uvs = atlas[k]
        # xatlas normalizes u by the width and v by the height; convert both to a common unit.
        uvs = np.nan_to_num(np.asarray(uvs, np.float64)) * [atlas.width, atlas.height]
        uvs /= max(atlas.width, atlas.height, 1)
        out[part] = _with_points(uvs, np.asarray(origin, np.int64), np.asarray(corners, np.int64))
    return out


def _parts(centers: np.ndarray, faces: np.ndarray) -> list[np.ndarray]:
    """Split `faces` (n,) into groups of at most `_TOGETHER` along their longest axis; centers (F, 3) of all faces."""
    if len(faces) <= _TOGETHER:
        return [faces]
    order = faces[np.argsort(centers[faces, np.ptp(centers[faces], axis=0).argmax()], kind="stable")]
    return _parts(centers, order[: len(order) // 2]) + _parts(centers, order[len(order) // 2 :])


def _with_points(uvs: np.ndarray, origin: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the UVs (F, 3, 2) with faces in no chart, at (0, 0), collapsed to a point at a corner in a chart."""
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
    """Smooth the vertices without shrinkage (Taubin 1995), since roughness would split charts."""
    count = len(vertices)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.concatenate([edges, edges[:, ::-1]])
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    shortest = np.full(count, np.inf)
    np.minimum.at(shortest, edges[:, 0], length)
    # Closer neighbors have larger weights, so that flat parts with faces of different sizes do not move.
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
