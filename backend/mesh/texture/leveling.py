"""Color leveling of the photos of one surface.

View-dependent highlights and shading cause photos of the same point to differ, with seams between areas textured from
different photos. Therefore the difference of each photo from the median of all photos, smoothed along the surface, is
subtracted. Finer detail is preserved (cf. Waechter et al. 2014, who level photos against each other at the seams).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import prange
from scipy.sparse import diags, eye

from ...raster.kernel import kernel
from ..surface import neighbors
from .photos import Photo, Photos, between, look

_MAX_SAMPLES = 64
"""Largest number of photos from which the median is computed."""
_STEPS = 40
"""Number of smoothing steps of the differences; the radius in edges is its square root."""


def level(photos: Photos, normals: np.ndarray, progress: Callable[[int], None]) -> dict[int, np.ndarray]:
    """Compute the offsets (V, 3) float32 to each photo's colors at the vertices, by the photo's index.

    normals (V, 3): unit normals of the vertices; progress: called with the number of processed photos. Photos that show
    no vertex are left out.
    """
    sampled = photos.indices[:: max(1, -(-len(photos.indices) // _MAX_SAMPLES))]
    seen: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for done, index in enumerate(photos.indices):
        progress(done)
        photo = photos[index]
        if photo is not None:
            weight, color = _at_vertices(photo, photos.vertices, normals)
            if weight.any():
                seen[index] = weight, color
    if not seen:
        return {}
    samples = [seen[index] for index in sampled if index in seen] or list(seen.values())[:_MAX_SAMPLES]
    medians, known = _medians(np.stack([color for _, color in samples]), np.stack([weight for weight, _ in samples]))
    near = neighbors(photos.vertices, photos.faces)
    mean = diags(1 / np.maximum(np.asarray(near.sum(1)).ravel(), 1e-30)) @ near
    smooth = ((eye(len(normals)) + mean) / 2).astype(np.float32).tocsr()
    offsets = {}
    for index, (weight, color) in seen.items():
        sure = np.where(known, weight, 0)[:, None]
        sums = np.concatenate([(medians - color) * sure, sure], 1).astype(np.float32)
        for _ in range(_STEPS):
            sums = smooth @ sums
        offsets[index] = sums[:, :3] / np.maximum(sums[:, 3:], 1e-9)
    return offsets


def _at_vertices(photo: Photo, vertices: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the photo's weights (V,) float32, 0 where not visible, and colors (V, 3) float32 at the vertices."""
    viewmat, intrinsics = photo.camera.arrays()
    weight = np.zeros(len(vertices), np.float32)
    color = np.zeros((len(vertices), 3), np.float32)
    _look(
        vertices, normals, photo.planes, photo.depth, photo.clearance, viewmat, intrinsics, photo.camera.center,
        (photo.x, photo.y), photo.safe, weight, color,
    )  # fmt: skip
    return weight, color


@kernel(parallel=True)
def _look(vertices, normals, planes, depth, clearance, viewmat, intrinsics, camera_center, corner, safe, weight, color):
    for n in prange(vertices.shape[0]):
        score, u, v, _clear = look(
            vertices, normals, n, 0.0, camera_center, viewmat, intrinsics, depth, clearance, safe
        )
        if score <= 0.0:
            continue
        # Pixels per unit of length on the surface.
        weight[n] = np.sqrt(score)
        for c in range(3):
            color[n, c] = between(planes[c], u + corner[0], v + corner[1])


def _medians(colors: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted median (V, 3) of colors (P, V, 3) with weights (P, V), and where it exists, (V,) bool."""
    order = np.argsort(colors, 0)
    behind = np.cumsum(np.take_along_axis(np.broadcast_to(weights[..., None], colors.shape), order, 0), 0)
    middle = (behind >= behind[-1] / 2).argmax(0)[None]
    return np.take_along_axis(np.take_along_axis(colors, order, 0), middle, 0)[0], behind[-1, :, 0] > 0
