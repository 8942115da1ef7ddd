"""Normals of surfaces, from points that lie on them and from their depth, and where surfaces are concave."""

from __future__ import annotations

import numpy as np

from ..raster import Camera

_APART = 2
"""Distance of the pixels by whose depth a normal is measured, in pixels."""
_STEEPEST = 6.0
"""Largest distance of two of these points, relative to that on a surface that faces the camera; more is a gap."""
_COVERED = 0.7
"""Least alpha of a pixel with a normal."""


def measure_normals(neighborhoods: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """Return the normals (n, 3) of neighborhoods (n, k, 3), on the side of `facing` (n, 3)."""
    centered = neighborhoods - neighborhoods.mean(1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", centered, centered))
    normal = axes[:, :, 0]
    return np.where((normal * facing).sum(1, keepdims=True) < 0, -normal, normal)


def normals_of_depth(depth: np.ndarray, alpha: np.ndarray, camera: Camera) -> np.ndarray:
    """Measure the normals of rendered surfaces by the differences of their depth.

    Args:
        depth: (H, W), expected depth times alpha.
        alpha: (H, W).
        camera: the camera that they were rendered for.

    Returns:
        (3, H, W) float32: unit normals in world space, towards the camera; 0 at the image's border, at gaps, and where
        hardly anything is.
    """
    viewmat, (fx, fy, cx, cy) = camera.arrays()
    height, width = depth.shape
    z = depth / np.maximum(alpha, 1e-6)
    x = (np.arange(width, dtype=np.float32) + 0.5 - cx) / fx * z
    y = (np.arange(height, dtype=np.float32)[:, None] + 0.5 - cy) / fy * z
    points, s = np.stack([x, y, z], -1), _APART
    found = np.zeros((3, height, width), np.float32)
    if min(height, width) <= 2 * s:
        return found
    right = points[s:-s, 2 * s :] - points[s:-s, : -2 * s]
    down = points[2 * s :, s:-s] - points[: -2 * s, s:-s]
    across = np.cross(down, right)
    across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
    across *= np.where((across * points[s:-s, s:-s]).sum(-1, keepdims=True) > 0, -1, 1)
    usual = 2 * s * z[s:-s, s:-s]
    length = np.maximum(fx * np.linalg.norm(right, axis=-1), fy * np.linalg.norm(down, axis=-1))
    known = (length < _STEEPEST * usual) & (alpha[s:-s, s:-s] > _COVERED)
    found[:, s:-s, s:-s] = np.moveaxis((across * known[..., None]) @ np.asarray(viewmat[:3, :3]), -1, 0)
    return found


def bending(xyz: np.ndarray, normal: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return how a surface bends along edges (m,): the change of the normals, negative where it is concave.

    Args:
        xyz: (n, 3) positions.
        normal: (n, 3) normals.
        first, second: (m,) ends of the edges.
    """
    along = xyz[second] - xyz[first]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    return ((normal[second] - normal[first]) * along).sum(1)


def concavity(xyz: np.ndarray, normal: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return how concave the surface is along edges (m,), 0 where it is flat or convex; arguments as for `bending`."""
    return np.maximum(0.0, -bending(xyz, normal, first, second))
