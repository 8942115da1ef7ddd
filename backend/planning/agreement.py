"""How well photos show what their neighbors show, which tells before a training how exact it can become."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image as PilImage
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from ..capture import Capture
from ..shared.stopping import Check, proceed

_PHOTOS = 16
"""Largest number of photos that are compared with their neighbors."""

_NEIGHBORS = 3
"""Number of neighbors that a photo is compared with."""

_LONGEST_SIDE = 320
"""Largest length of the compared photos' longer side, in pixels."""

_NEAR = 1 / 40
"""Largest distance of the compared pixels from a point of known depth, as a fraction of the longer side."""

_BEST = 0.5
"""Fraction of the pixels, those that agree best, that counts: the others are edges and what one photo hides."""

_LIMIT = 45.0
"""Largest agreement in dB; more is below the noise of 8-bit photos."""

_FEWEST = 50
"""Fewest pixels, and a fifth of it the fewest points, for a comparison."""

_MOST_POINTS = 20_000
"""Largest number of points of a photo whose depths are used."""


def measure_agreement(capture: Capture, check: Check = proceed) -> float | None:
    """Return how well photos agree with what their neighbors show at the depths of the capture's points.

    Each of some photos is predicted from the training views that see the middle of the scene from the most similar
    directions: near a point, the depth is that of the points around, and each neighbor's colors are fitted to the
    photo, as exposure differs.

    Args:
        capture: The capture; must be prepared.
        check: Called at intervals; ends the work by an exception once the user wants to stop.

    Returns:
        The median PSNR of the half of each photo's pixels that agree best, in dB; None if too few can be compared.

    Raises:
        InputError: A photo cannot be read.
    """
    views = capture.train_indices
    chosen = np.unique(np.linspace(0, len(views) - 1, min(len(views), _PHOTOS)).astype(int))
    found = []
    for place in chosen:
        check()
        value = _agreement_of(capture, views, int(place))
        if value is not None:
            found.append(value)
    return float(np.median(found)) if found else None


def _agreement_of(capture: Capture, views: Sequence[int], place: int) -> float | None:
    """Return the PSNR of one photo, that of views[place]; None if too little can be compared."""
    index = views[place]
    view, (photo, K) = capture.views[index], _scaled(capture, index)
    observed = capture.observed(index)
    xyz = capture.points.xyz[observed] if len(observed) >= _FEWEST // 5 else capture.points.xyz
    xyz = xyz[:: max(len(xyz) // _MOST_POINTS, 1)]
    positions = view.to_camera(xyz)
    inside, _, _ = view.pixels_of(positions)
    positions = positions[inside]
    if len(positions) < _FEWEST // 5:
        return None
    height, width = photo.shape[:2]
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 2) + 0.5
    shown = positions @ K.T
    distances, nearest = cKDTree(shown[:, :2] / shown[:, 2:]).query(
        pixels, _NEIGHBORS, distance_upper_bound=_NEAR * max(width, height)
    )
    near = np.isfinite(distances[:, 0])
    weights = 1.0 / (distances[near] + 1.0)
    inverse = np.append(1.0 / positions[:, 2], 0.0)[nearest[near]]
    depths = weights.sum(1) / (weights * inverse).sum(1)
    rays = np.column_stack([pixels[near], np.ones(int(near.sum()))]) @ np.linalg.inv(K).T
    world = (rays * depths[:, None] - view.viewmat[:3, 3]) @ view.viewmat[:3, :3]
    target = photo.reshape(-1, 3)[near]
    total, seen = np.zeros_like(target), np.zeros(len(target))
    for other in _nearest(capture, views, place, float(np.median(positions[:, 2]))):
        colors, visible = _colors_at(capture, other, world)
        if visible.sum() >= _FEWEST:
            total[visible] += _fitted(colors[visible], target[visible])
            seen += visible
    compared = seen > 0
    if compared.sum() < _FEWEST:
        return None
    errors = np.sort(((total[compared] / seen[compared, None] - target[compared]) ** 2).mean(1))
    return float(-10.0 * np.log10(max(errors[: int(_BEST * len(errors))].mean(), 10.0 ** (-0.1 * _LIMIT))))


def _nearest(capture: Capture, views: Sequence[int], place: int, depth: float) -> list[int]:
    """Return the views that see what is at a depth before views[place] from the most similar directions."""
    matrices = np.array([capture.views[index].viewmat for index in views])
    centers = -np.einsum("nij,ni->nj", matrices[:, :3, :3], matrices[:, :3, 3])
    axes = matrices[:, 2, :3]
    rays = centers - (centers[place] + axes[place] * depth)
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    # Of views from the same position, those that look elsewhere show less of the same.
    similarity = np.minimum(rays @ rays[place], np.cos(0.5 * np.arccos(np.clip(axes @ axes[place], -1.0, 1.0))))
    similarity[place] = -np.inf
    return [views[other] for other in np.argsort(-similarity, kind="stable")[:_NEIGHBORS] if other != place]


def _colors_at(capture: Capture, index: int, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the colors (n, 3) that a photo shows at positions (n, 3), and which of them are inside it."""
    view, (photo, K) = capture.views[index], _scaled(capture, index)
    shown = view.to_camera(xyz) @ K.T
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        x, y = (shown[:, :2] / shown[:, 2:]).T - 0.5
        visible = (shown[:, 2] > 0) & (x >= 0) & (y >= 0) & (x <= photo.shape[1] - 1) & (y <= photo.shape[0] - 1)
    at = np.where(visible, y, 0.0), np.where(visible, x, 0.0)
    return np.stack([map_coordinates(photo[..., channel], at, order=1) for channel in range(3)], -1), visible


def _fitted(colors: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return colors (n, 3) after the affine map with the least squared difference from those of the target (n, 3)."""
    terms = np.column_stack([colors, np.ones(len(colors))])
    return terms @ np.linalg.lstsq(terms, target, rcond=1e-6)[0]


def _scaled(capture: Capture, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a photo (h, w, 3) in [0, 1], scaled down if it is large, and the intrinsics (3, 3) of its pixels."""
    image = PilImage.fromarray(capture.image(index))
    factor = min(1.0, _LONGEST_SIDE / max(image.size))
    size = [max(round(side * factor), 1) for side in image.size]
    scale = np.diag([size[0] / image.width, size[1] / image.height, 1.0])
    pixels = np.asarray(image.resize(size, PilImage.Resampling.BOX), np.float64) / 255.0
    return pixels, scale @ capture.views[index].K
