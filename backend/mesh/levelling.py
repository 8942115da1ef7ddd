"""Photographs of one surface brought to the same colours.

Gloss and shade move with the camera: photos that show the same place differ, and a seam is left wherever one takes
over from another. All photos together say what a place looks like mostly; what each of them differs from that, smoothed
along the surface, is taken off it. Detail stays, as it is finer than what is taken off (cf. Waechter et al. 2014, who
level photos against each other at the seams).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import prange
from scipy.sparse import diags, eye

from ..raster.kernel import kernel
from .photos import Photo, Photos, between, look
from .surface import neighbours

_ASKED = 64
"""Photos, at most, that say what a place looks like mostly."""
_STEPS = 40
"""Rounds in which neighbours share what a photo differs by: over the square root of it, in edges."""


def level(photos: Photos, normals: np.ndarray, progress: Callable[[int], None]) -> dict[int, np.ndarray]:
    """What is to be added to each photo's colours at the vertices, (V, 3) float32, by the photo's index.

    normals (V, 3): the vertices' unit normals; progress: told how many photos were looked at. Photos that show no
    vertex are left out.
    """
    asked = photos.indices[:: max(1, -(-len(photos.indices) // _ASKED))]
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
    judges = [seen[index] for index in asked if index in seen] or list(seen.values())[:_ASKED]
    mostly, known = _medians(np.stack([color for _, color in judges]), np.stack([weight for weight, _ in judges]))
    near = neighbours(photos.vertices, photos.faces)
    mean = diags(1 / np.maximum(np.asarray(near.sum(1)).ravel(), 1e-30)) @ near
    share = ((eye(len(normals)) + mean) / 2).astype(np.float32).tocsr()
    offsets = {}
    for index, (weight, color) in seen.items():
        sure = np.where(known, weight, 0)[:, None]
        sums = np.concatenate([(mostly - color) * sure, sure], 1).astype(np.float32)
        for _ in range(_STEPS):
            sums = share @ sums
        offsets[index] = sums[:, :3] / np.maximum(sums[:, 3:], 1e-9)
    return offsets


def _at_vertices(photo: Photo, vertices: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How well the photo shows each vertex, (V,) float32, 0: not at all; and its colours there, (V, 3) float32."""
    viewmat, intrinsics = photo.camera.arrays()
    weight = np.zeros(len(vertices), np.float32)
    color = np.zeros((len(vertices), 3), np.float32)
    _look(
        vertices, normals, photo.planes, photo.depth, photo.clearance, viewmat, intrinsics, photo.camera.centre,
        (photo.x, photo.y), photo.safe, weight, color,
    )  # fmt: skip
    return weight, color


@kernel(parallel=True)
def _look(vertices, normals, planes, depth, clearance, viewmat, intrinsics, eye, corner, safe, weight, color):
    for n in prange(vertices.shape[0]):
        score, u, v, _clear = look(vertices, normals, n, 0.0, eye, viewmat, intrinsics, depth, clearance, safe)
        if score <= 0.0:
            continue
        # As many pixels as a side of the place has.
        weight[n] = np.sqrt(score)
        for c in range(3):
            color[n, c] = between(planes[c], u + corner[0], v + corner[1])


def _medians(colors: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The weighted median (V, 3) over P photos' colours (P, V, 3) of weights (P, V); and where there is any, (V,)."""
    order = np.argsort(colors, 0)
    behind = np.cumsum(np.take_along_axis(np.broadcast_to(weights[..., None], colors.shape), order, 0), 0)
    middle = (behind >= behind[-1] / 2).argmax(0)[None]
    return np.take_along_axis(np.take_along_axis(colors, order, 0), middle, 0)[0], behind[-1, :, 0] > 0
