"""Which way is up in a capture, and where its ground lies: COLMAP's frame is arbitrary, Blender wants Z up.

Up is what the cameras say (photos are taken level, more or less), made exact by the largest level plane of the points
where there is one: a floor, or the top of a table.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LEVEL_WITHIN = np.cos(np.radians(25.0))
"""The plane's normal may differ so much from what the cameras call up: more, and it is a wall or a slope."""
PLANE_SHARE = 0.12
"""Of the points, a plane must hold so many, and 4 standard deviations more, since the best of thousands is picked."""
PLANE_CONTRAST = 2.0
"""So many times as dense as just above and below it points must be in a plane; in a shapeless cloud it is up to 1.5."""
PLANE_THICKNESS = 0.01
"""Distance from the plane, as a share of the scene's size, within which a point belongs to it."""
UPRIGHT_WITHIN = np.radians(2.0)
ON_GROUND_WITHIN = 0.02
"""A capture this near to upright, and its ground this near to 0 as a share of the scene's size, is left as it is."""
LOWEST_PERCENT = 2.0

_TRIPLES = 4000
_POINTS_SCORED = 4000
_FEWEST_IN_PLANE = 12
_FLOAT32_RELATIVE_ERROR = 2.0**-24
_AGREE = 0.3
"""Length of the mean of the cameras' unit up vectors, below which they cancel out and say nothing."""


@dataclass(frozen=True)
class Upright:
    """world = rotation @ (capture - origin) + translation: Z up, ground at z = 0. origin (3,), rotation (3, 3) proper,
    translation (3,), all float64 and finite."""

    origin: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray


def stand_up(viewmats: np.ndarray, xyz: np.ndarray) -> Upright:
    """How to stand a capture up. viewmats (V, 4, 4) world to camera, OpenCV axes; xyz (M, 3) points.

    The rotation is the smallest that brings up to +Z, so the heading stays; the identity where the capture is upright
    already. The origin is 0, except where the capture lies so far out that float32 coordinates would suffer.
    """
    centres = -np.einsum("vji,vj->vi", viewmats[:, :3, :3], viewmats[:, :3, 3])
    xyz = xyz[np.isfinite(xyz).all(1)]
    middle = np.median(xyz, axis=0)
    distances = np.linalg.norm(xyz - middle, axis=1)
    reach = float(np.percentile(distances, 90))
    size = max(2 * reach, float(np.median(np.linalg.norm(centres - middle, axis=1))))
    origin = _origin(middle, size)
    near = xyz[distances <= 3 * reach] - origin
    up = _cameras_up(viewmats)
    plane = _level_plane(near, up, PLANE_THICKNESS * size, centres - origin)
    if plane is not None:
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
    """0, or the middle of a far-away capture, rounded to what the scene's size makes a round number."""
    far = float(np.abs(middle).max())
    if far * _FLOAT32_RELATIVE_ERROR <= 1e-6 * size or far == 0:
        return np.zeros(3)
    # A scene without any size is as large as its coordinates are exact.
    step = 10.0 ** np.floor(np.log10(max(size, far * 1e-9)))
    return np.round(middle / step) * step


def _cameras_up(viewmats: np.ndarray) -> np.ndarray:
    """Up (3,) by the cameras alone.

    Their own up vectors lean forward where they look down, which only a full circle around the scene evens out. Their
    right vectors are level however the cameras are pitched, so up is what is square to them all, where they differ
    enough to say. Cameras that were turned on their side count less with every pass.
    """
    ups, rights, backs = -viewmats[:, 1, :3], viewmats[:, 0, :3], -viewmats[:, 2, :3]
    # Pictures straight down have their up vectors in any heading: then up is what they all look away from.
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
    """The mean of unit vectors (n, 3), those far from it counting less."""
    mean = vectors.mean(0)
    for _ in range(10):
        weights = 1 / np.maximum(np.linalg.norm(vectors - mean, axis=1), 0.05)
        mean = (weights[:, None] * vectors).sum(0) / weights.sum()
    return mean


def _level_plane(
    xyz: np.ndarray, up: np.ndarray, thickness: float, cameras: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """The level plane below most of the cameras (V, 3) that holds most of the points xyz (M, 3), if it holds enough:
    its normal (3,) and which points it holds (M,) bool."""
    if len(xyz) < _FEWEST_IN_PLANE or thickness <= 0:
        return None
    rng = np.random.default_rng(0)
    some = xyz[rng.permutation(len(xyz))[:_POINTS_SCORED]]
    a, b, c = some[rng.integers(0, len(some), (3, _TRIPLES))]
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    # Three points closer together than the plane is thick tell nothing of its slope.
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
            return None  # Points in a line or a heap: no plane.
        normal = axes[2] * (1 if axes[2] @ up >= 0 else -1)
        offset = float(middle @ normal)
    away = np.abs(xyz @ normal - offset)
    held_points = away <= thickness
    count = int(held_points.sum())
    expected = PLANE_SHARE * len(xyz)
    around = int(((away > thickness) & (away <= 3 * thickness)).sum())
    if normal @ up < LEVEL_WITHIN or count < expected + 4 * np.sqrt(expected) or count < PLANE_CONTRAST * around / 2:
        return None
    return normal, held_points


def _smallest_rotation(up: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) that brings the unit vector `up` to +Z about the axis square to both."""
    x, y, z = up
    level = x * x + y * y
    if z < 0 and level < 1e-24:
        return np.diag([1.0, -1.0, -1.0])
    # 1 / (1 + z), of which little is left where z is near -1.
    k = (1 - z) / level if z < 0 else 1 / (1 + z)
    return np.array([[1 - x * x * k, -x * y * k, -x], [-x * y * k, 1 - y * y * k, -y], [x, y, z]])
