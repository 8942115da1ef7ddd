"""Estimation of the up direction and ground of a capture: COLMAP's frame is arbitrary, whereas Blender has Z up.

The up direction is estimated from the cameras, since most photos are taken level, and refined by the largest
horizontal plane of the points if there is one, such as a floor or a table top, unless the photos tell it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LEVEL_WITHIN = np.cos(np.radians(25.0))
"""Cosine of the largest angle between the plane's normal and the cameras' up; beyond, it is a wall or a slope."""
PLANE_FRACTION = 0.12
"""Smallest fraction of the points in the plane; 4 standard deviations are added, as it is the best of thousands."""
PLANE_CONTRAST = 2.0
"""Smallest density of points in the plane, relative to just above and below it; a shapeless cloud reaches 1.5."""
PLANE_THICKNESS = 0.01
"""Largest distance of the plane's points from it, as a fraction of the scene's size."""
UPRIGHT_WITHIN = np.radians(2.0)
ON_GROUND_WITHIN = 0.02
"""A capture is not rotated if it is upright within this angle, and the ground is not moved if its height is within this
fraction of the scene's size of 0."""
LOWEST_PERCENT = 2.0

_TRIPLES = 4000
_POINTS_SCORED = 4000
_FEWEST_IN_PLANE = 12
_FLOAT32_RELATIVE_ERROR = 2.0**-24
_AGREE = 0.3
"""Smallest length of the mean of the cameras' unit up vectors; below, they cancel out and give no direction."""


@dataclass(frozen=True)
class Upright:
    """The transform to a world with Z up and the ground at z = 0: world = rotation @ (capture - origin) + translation.

    origin (3,), rotation (3, 3) proper, translation (3,), all float64 and finite.
    """

    origin: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray


def compute_upright(viewmats: np.ndarray, xyz: np.ndarray, known: np.ndarray | None = None) -> Upright:
    """Compute the transform that makes a capture upright.

    Args:
        viewmats: (V, 4, 4), world to camera, OpenCV axes.
        xyz: (M, 3), points.
        known: (3,), what is up, if it was measured; only the ground's height is then that of a plane.

    Returns:
        The transform. Its rotation is the smallest one that rotates up to +Z, which keeps the heading, or the identity
        if the capture is already upright. Its origin is 0, unless the capture is so far from 0 that float32 coordinates
        would be inaccurate.
    """
    centers = -np.einsum("vji,vj->vi", viewmats[:, :3, :3], viewmats[:, :3, 3])
    xyz = xyz[np.isfinite(xyz).all(1)]
    middle = np.median(xyz, axis=0)
    distances = np.linalg.norm(xyz - middle, axis=1)
    reach = float(np.percentile(distances, 90))
    size = max(2 * reach, float(np.median(np.linalg.norm(centers - middle, axis=1))))
    origin = _origin(middle, size)
    near = xyz[distances <= 3 * reach] - origin
    up = _cameras_up(viewmats) if known is None else known / np.linalg.norm(known)
    plane = _level_plane(near, up, PLANE_THICKNESS * size, centers - origin)
    if plane is not None and known is None:
        up = plane[0]
    rotation = _smallest_rotation(up)
    if np.arccos(np.clip(up[2], -1, 1)) <= UPRIGHT_WITHIN:
        rotation = np.eye(3)
    standing_on = near if plane is None else near[plane[1]]
    heights = standing_on @ rotation[2]
    ground = float(np.percentile(heights, LOWEST_PERCENT if plane is None else 50))
    if abs(ground) <= ON_GROUND_WITHIN * size and (rotation == np.eye(3)).all():
        ground = 0.0
    return Upright(origin, rotation, np.array([0.0, 0.0, -ground]))


def _origin(middle: np.ndarray, size: float) -> np.ndarray:
    """Return 0 or, for a capture far from 0, its center rounded to the order of magnitude of the scene's size."""
    far = float(np.abs(middle).max())
    if far * _FLOAT32_RELATIVE_ERROR <= 1e-6 * size or far == 0:
        return np.zeros(3)
    # The precision of the coordinates is a lower limit of the size.
    step = 10.0 ** np.floor(np.log10(max(size, far * 1e-9)))
    return np.round(middle / step) * step


def _cameras_up(viewmats: np.ndarray) -> np.ndarray:
    """Estimate up (3,) from the cameras alone.

    The up vectors of cameras that look down are tilted, which averages out only over a full circle around the scene.
    The right vectors are horizontal at any pitch, so up is orthogonal to all of them, if they differ enough. Iterative
    reweighting suppresses cameras that were turned on their side.
    """
    ups, rights, backs = -viewmats[:, 1, :3], viewmats[:, 0, :3], -viewmats[:, 2, :3]
    # The up vectors of cameras that look straight down have any heading; then up is opposite to the view directions.
    mean = _robust_mean(ups if np.linalg.norm(ups.mean(0)) >= _AGREE else backs)
    length = float(np.linalg.norm(mean))
    if length < 1e-6:
        return np.array([0.0, 0.0, 1.0])
    mean /= length
    weights = np.ones(len(rights))
    for _ in range(10):
        values, vectors = np.linalg.eigh(np.einsum("v,vi,vj->ij", weights, rights, rights) / weights.sum())
        square = vectors[:, 0] * (1 if vectors[:, 0] @ mean >= 0 else -1)
        weights = 1 / np.maximum(np.abs(rights @ square), 0.02)
    spread, thickness = values[1], values[0]
    return square if spread > 0.02 and thickness < 0.1 * spread and square @ mean > 0.5 else mean


def _robust_mean(vectors: np.ndarray) -> np.ndarray:
    """Return the mean of unit vectors (n, 3), with less weight for outliers."""
    mean = vectors.mean(0)
    for _ in range(10):
        weights = 1 / np.maximum(np.linalg.norm(vectors - mean, axis=1), 0.05)
        mean = (weights[:, None] * vectors).sum(0) / weights.sum()
    return mean


def _level_plane(
    xyz: np.ndarray, up: np.ndarray, thickness: float, cameras: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Find the horizontal plane below most of the cameras (V, 3) that contains the most of the points xyz (M, 3).

    Returns its normal (3,) and a mask of its points (M,) bool; None if it has too few points.
    """
    if len(xyz) < _FEWEST_IN_PLANE or thickness <= 0:
        return None
    rng = np.random.default_rng(0)
    some = xyz[rng.permutation(len(xyz))[:_POINTS_SCORED]]
    a, b, c = some[rng.integers(0, len(some), (3, _TRIPLES))]
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    # Three points that are closer together than the plane's thickness do not determine its slope.
    keep = lengths > thickness**2
    normals, a = normals[keep] / lengths[keep, None], a[keep]
    normals *= np.sign(normals @ up)[:, None]
    offsets = (normals * a).sum(1)
    keep = (normals @ up >= LEVEL_WITHIN) & (offsets < np.median(cameras @ normals.T, axis=0))
    if not keep.any():
        return None
    normals, offsets = normals[keep], offsets[keep]
    held = [(np.abs(some @ normal - offset) <= thickness).sum() for normal, offset in zip(normals, offsets)]
    normal, offset = normals[np.argmax(held)], offsets[np.argmax(held)]
    for _ in range(5):
        held_points = np.abs(xyz @ normal - offset) <= thickness
        if not held_points.any():
            return None
        middle = xyz[held_points].mean(0)
        _, extents, axes = np.linalg.svd(xyz[held_points] - middle, full_matrices=False)
        if len(axes) < 3 or extents[1] <= 4 * extents[2]:
            return None  # Points in a line or a cluster: no plane.
        normal = axes[2] * (1 if axes[2] @ up >= 0 else -1)
        offset = float(middle @ normal)
    away = np.abs(xyz @ normal - offset)
    held_points = away <= thickness
    count = int(held_points.sum())
    expected = PLANE_FRACTION * len(xyz)
    around = int(((away > thickness) & (away <= 3 * thickness)).sum())
    if normal @ up < LEVEL_WITHIN or count < expected + 4 * np.sqrt(expected) or count < PLANE_CONTRAST * around / 2:
        return None
    return normal, held_points


def _smallest_rotation(up: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) that rotates the unit vector `up` to +Z, about the axis orthogonal to both."""
    x, y, z = up
    level = x * x + y * y
    if z < 0 and level < 1e-24:
        return np.diag([1.0, -1.0, -1.0])
    # 1 / (1 + z), without cancellation near z = -1.
    k = (1 - z) / level if z < 0 else 1 / (1 + z)
    return np.array([[1 - x * x * k, -x * y * k, -x], [-x * y * k, 1 - y * y * k, -y], [x, y, z]])
