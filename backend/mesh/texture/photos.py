"""Photos of a surface: the pixels that show only the surface, their quality, and blending of their colors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from ...raster import devices
from ...raster.camera import Camera
from ...raster.kernel import kernel
from ..views import Views
from .zbuffer import draw_mesh

KEPT = 6
"""Largest number of photos blended in a texel."""

_CLEAR = 1.5
"""Distance in pixels from an outline of the surface up to which a pixel may show something beyond it."""

_SAFE = 4.0
"""Distance in pixels from an outline at which it no longer reduces the score, in photos of up to `_SMALL` pixels."""

_SMALL = 800
_CUBIC = 2.5
"""Distance in pixels from an outline from which on bicubic interpolation reads no pixel beyond it."""

_STEP = 6.0
"""Smallest depth difference between neighboring pixels at an outline, in pixel sizes on the surface."""

_BEHIND = 3.0
"""Largest distance of a visible point behind the depth map, in pixel sizes on the surface."""

_GRAZING = 0.1
"""Smallest cosine between normal and view direction for a photo to be used."""

_SHARPNESS = 3.0
"""Exponent of the score in the weight of a photo."""

_ODD = 0.25
"""Difference from the median color, 0 .. 1, that reduces the weight of a photo to 1 / e (highlights, passers-by)."""


_HELD = 300e6
"""Size of the photo cache in bytes."""

_NO_PLANES = np.zeros((0, 0, 0), np.float32)


class Photo(NamedTuple):
    """A photo of a surface.

    Attributes:
        planes: (3, H, W) float32, at the common exposure.
        camera: Camera of the rectangle (h, w) that contains the surface.
        x, y: Upper left pixel of the rectangle.
        depth: (h, w) float32, depth of the surface, 0 where there is none.
        clearance: (h, w) float32, distance in pixels from the nearest pixel that shows something else.
        safe: Clearance above which the score does not increase.
    """

    planes: np.ndarray
    camera: Camera
    x: int
    y: int
    depth: np.ndarray
    clearance: np.ndarray
    safe: float


class Samples(NamedTuple):
    """The best photos of N points: score (N, KEPT + 1) float32, descending, 0 if none; color (N, KEPT, 3) uint8."""

    score: np.ndarray
    color: np.ndarray

    @classmethod
    def none(cls, count: int) -> Samples:
        """Return empty samples for `count` points."""
        return cls(np.zeros((count, KEPT + 1), np.float32), np.zeros((count, KEPT, 3), np.uint8))


class Photos:
    """All photos of one surface: vertices (V, 3) float64 in scene units, faces (F, 3) int32, of the objects `classes`.

    photos[i] is the photo of view i, None if the surface is out of view. Photos are cached up to a memory limit.
    """

    def __init__(self, views: Views, vertices: np.ndarray, faces: np.ndarray, classes: Sequence[int]) -> None:
        self.views, self.classes, self.indices = views, classes, views.indices
        self.vertices = np.ascontiguousarray(vertices, np.float64)
        self.faces = np.ascontiguousarray(faces, np.int32)
        self._held: dict[int, Photo | None] = {}
        self._room = float(_HELD)

    def __getitem__(self, index: int) -> Photo | None:
        if index not in self._held:
            photo = _photo_of(self.views, index, self.vertices, self.faces, self.classes)
            size = 0 if photo is None else photo.depth.nbytes + photo.clearance.nbytes
            if size > self._room:
                return photo
            self._room -= size
            # The scene caches the planes.
            self._held[index] = None if photo is None else photo._replace(planes=_NO_PLANES)
        photo = self._held[index]
        if photo is None:
            return None
        return photo._replace(planes=devices.host(self.views.scene.target(index)[0]))


def _photo_of(
    views: Views, index: int, vertices: np.ndarray, faces: np.ndarray, classes: Sequence[int]
) -> Photo | None:  # fmt: skip
    whole = views.scene.camera(index)
    box = _box(vertices, whole)
    if box is None:
        return None
    x, y, width, height = box
    camera = whole.crop(x, y, width, height)
    depth, _, _ = draw_mesh(vertices, faces, camera)
    image, labels = views.scene.target(index)
    # Contiguous, as the kernel would be compiled once more for other arrays.
    allowed = np.ascontiguousarray(
        _allowed(views, index, None if labels is None else devices.host(labels), classes, box)
    )
    clearance = np.empty((height, width), np.float32)
    focal = (camera.K[0, 0] + camera.K[1, 1]) / 2
    _measure_clearance(depth, allowed, _STEP / focal, clearance)
    safe = _SAFE * max(1.0, max(whole.width, whole.height) / _SMALL)
    return Photo(devices.host(image), camera, x, y, depth, clearance, safe)


def _allowed(
    views: Views, index: int, labels: np.ndarray | None, classes: Sequence[int], box: tuple[int, int, int, int]
) -> np.ndarray:
    """Return which pixels of `box` show the objects, (h, w) bool: from the mask, or from the model where unlabeled."""
    x, y, width, height = box
    ours = np.zeros(len(views.model.classes) + 1, np.bool_)  # the last one for the index -1
    ours[list(classes)] = True
    if labels is not None:
        shown = ours[labels]
        unlabeled = labels[y : y + height, x : x + width] < 0
        # A mask that contains the objects is assumed to be complete.
        if not unlabeled.any() or (shown.any() and 0 not in classes):
            return shown[y : y + height, x : x + width]
    modeled = ours[views.scene_map(index).ids[y : y + height, x : x + width]]
    return modeled if labels is None else np.where(unlabeled, modeled, shown[y : y + height, x : x + width])


def _box(vertices: np.ndarray, camera: Camera) -> tuple[int, int, int, int] | None:
    """Return the rectangle of the image that contains the mesh: x, y, width, height; None if it is out of view."""
    seen = vertices @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    front = seen[:, 2] > camera.near
    size = np.array([camera.width, camera.height])
    if not front.any():
        return None
    low, high = np.zeros(2), size.astype(np.float64)
    if front.all():
        pixels = seen[:, :2] / seen[:, 2:] * [camera.K[0, 0], camera.K[1, 1]] + camera.K[:2, 2]
        low, high = pixels.min(0) - 2, pixels.max(0) + 2
    first = np.clip(np.floor(low), 0, size).astype(int)
    last = np.clip(np.ceil(high), 0, size).astype(int)
    if (last <= first).any():
        return None
    return int(first[0]), int(first[1]), int(last[0] - first[0]), int(last[1] - first[1])


@kernel()
def _measure_clearance(depth, allowed, step, clearance):
    """Compute each pixel's distance to the nearest one that is not `allowed`, without depth or across a depth step.

    Chamfer distance transform in two passes (Borgefors 1986). step: smallest depth step, as a fraction of the depth.
    """
    height, width = depth.shape
    far = np.float32(height + width)
    one, diagonal = np.float32(1.0), np.float32(1.4142135)
    for row in range(height):
        for column in range(width):
            z = depth[row, column]
            value = far if z > 0 and allowed[row, column] else np.float32(0.0)
            if value > 0:
                if column + 1 < width and abs(depth[row, column + 1] - z) > step * z:
                    value = one
                if column > 0 and abs(depth[row, column - 1] - z) > step * z:
                    value = one
                if row + 1 < height and abs(depth[row + 1, column] - z) > step * z:
                    value = one
                if row > 0 and abs(depth[row - 1, column] - z) > step * z:
                    value = one
            clearance[row, column] = value
    for row in range(height):
        for column in range(width):
            value = clearance[row, column]
            if column > 0:
                value = min(value, clearance[row, column - 1] + one)
            if row > 0:
                value = min(value, clearance[row - 1, column] + one)
                if column > 0:
                    value = min(value, clearance[row - 1, column - 1] + diagonal)
                if column + 1 < width:
                    value = min(value, clearance[row - 1, column + 1] + diagonal)
            clearance[row, column] = value
    for row in range(height - 1, -1, -1):
        for column in range(width - 1, -1, -1):
            value = clearance[row, column]
            if column + 1 < width:
                value = min(value, clearance[row, column + 1] + one)
            if row + 1 < height:
                value = min(value, clearance[row + 1, column] + one)
                if column + 1 < width:
                    value = min(value, clearance[row + 1, column + 1] + diagonal)
                if column > 0:
                    value = min(value, clearance[row + 1, column - 1] + diagonal)
            clearance[row, column] = value


def add_photo(
    photo: Photo, positions: np.ndarray, normals: np.ndarray, corners: np.ndarray, weights: np.ndarray,
    offsets: np.ndarray, samples: Samples,
) -> None:  # fmt: skip
    """Insert a photo into the best ones of each of N points, if its score is high enough.

    Args:
        photo: The photo.
        positions: (N, 3) float32 in scene units.
        normals: (N, 3) float32 unit normals.
        corners: (N, 3) int32 vertices of the faces that the points lie on.
        weights: (N, 3) float32 barycentric coordinates of the points.
        offsets: (V, 3) float32, added to the photo's colors; one for each vertex, interpolated.
        samples: The best photos so far, changed in place.
    """
    viewmat, intrinsics = photo.camera.arrays()
    _gather(
        positions, normals, corners, weights, offsets, photo.planes, photo.depth, photo.clearance, viewmat, intrinsics,
        photo.camera.center, (photo.x, photo.y), photo.safe, samples.score, samples.color,
    )  # fmt: skip


@kernel()
def _cubic(t, out):
    """Write the Catmull-Rom weights of four neighbors, at the fraction t between the second and the third."""
    out[0] = ((2.0 - t) * t - 1.0) * t / 2.0
    out[1] = ((3.0 * t - 5.0) * t * t + 2.0) / 2.0
    out[2] = ((4.0 - 3.0 * t) * t + 1.0) * t / 2.0
    out[3] = (t - 1.0) * t * t / 2.0


@njit(inline="always", error_model="numpy")
def look(positions, normals, n, least, camera_center, viewmat, intrinsics, depth, clearance, safe):
    """Score a photo at point `n`.

    viewmat, intrinsics and camera_center describe the photo's camera. Returns the score, 0 if the point is not visible
    or the score is not greater than `least`; the pixel (u, v), relative to pixel centers; its clearance.
    """
    fx, fy, cx, cy = intrinsics
    height, width = depth.shape
    focal = (fx + fy) / 2
    x, y, z = positions[n, 0], positions[n, 1], positions[n, 2]
    dx, dy, dz = camera_center[0] - x, camera_center[1] - y, camera_center[2] - z
    facing = dx * normals[n, 0] + dy * normals[n, 1] + dz * normals[n, 2]
    if facing <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    facing /= np.sqrt(dx * dx + dy * dy + dz * dz)
    pz = viewmat[2, 0] * x + viewmat[2, 1] * y + viewmat[2, 2] * z + viewmat[2, 3]
    if facing < _GRAZING or pz <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    score = (facing * focal / pz) ** 2
    if score <= least:
        return 0.0, 0.0, 0.0, 0.0
    px = viewmat[0, 0] * x + viewmat[0, 1] * y + viewmat[0, 2] * z + viewmat[0, 3]
    py = viewmat[1, 0] * x + viewmat[1, 1] * y + viewmat[1, 2] * z + viewmat[1, 3]
    u = px / pz * fx + cx - 0.5
    v = py / pz * fy + cy - 0.5
    if not (u >= 0.0 and v >= 0.0 and u < width - 1 and v < height - 1):
        return 0.0, 0.0, 0.0, 0.0
    clear = between(clearance, u, v)
    if clear < _CLEAR or pz > between(depth, u, v) + _BEHIND * pz / focal:
        return 0.0, 0.0, 0.0, 0.0
    return score * max(min((clear - _CLEAR) / (safe - _CLEAR), 1.0), 1e-3), u, v, clear


@njit(inline="always", error_model="numpy")
def between(plane, u, v):
    """Interpolate a plane bilinearly at (u, v), relative to pixel centers; all four neighbors must be inside."""
    column, row = int(u), int(v)
    fu, fv = u - column, v - row
    return (plane[row, column] * (1 - fu) + plane[row, column + 1] * fu) * (1 - fv) + (
        plane[row + 1, column] * (1 - fu) + plane[row + 1, column + 1] * fu
    ) * fv


@kernel(parallel=True)
def _gather(
    positions, normals, corners, weights, offsets, planes, depth, clearance, viewmat, intrinsics, camera_center,
    corner, safe, scores, colors,
):  # fmt: skip
    block = 1024
    for b in prange((positions.shape[0] + block - 1) // block):
        across = np.empty(4)
        down = np.empty(4)
        color = np.empty(3)
        for n in range(b * block, min((b + 1) * block, positions.shape[0])):
            score, u, v, clear = look(
                positions, normals, n, scores[n, KEPT], camera_center, viewmat, intrinsics, depth, clearance, safe
            )
            if score <= scores[n, KEPT]:
                continue
            column, row = int(u) + corner[0], int(v) + corner[1]
            fu, fv = u - int(u), v - int(v)
            if (
                clear >= _CUBIC
                and column > 0
                and row > 0
                and column + 2 < planes.shape[2]
                and row + 2 < planes.shape[1]
            ):
                _cubic(fu, across)
                _cubic(fv, down)
                for c in range(3):
                    color[c] = 0.0
                    for j in range(4):
                        line = 0.0
                        for i in range(4):
                            line += across[i] * planes[c, row + j - 1, column + i - 1]
                        color[c] += down[j] * line
            else:
                for c in range(3):
                    color[c] = (planes[c, row, column] * (1 - fu) + planes[c, row, column + 1] * fu) * (1 - fv) + (
                        planes[c, row + 1, column] * (1 - fu) + planes[c, row + 1, column + 1] * fu
                    ) * fv
            for c in range(3):
                for i in range(3):
                    color[c] += weights[n, i] * offsets[corners[n, i], c]
            at = KEPT
            while at > 0 and scores[n, at - 1] < score:
                scores[n, at] = scores[n, at - 1]
                if at < KEPT:
                    for c in range(3):
                        colors[n, at, c] = colors[n, at - 1, c]
                at -= 1
            scores[n, at] = score
            if at < KEPT:
                for c in range(3):
                    colors[n, at, c] = int(min(max(color[c] * 255.0 + 0.5, 0.0), 255.0))


def blend(samples: Samples) -> tuple[np.ndarray, np.ndarray]:
    """Blend the photos of N points; returns colors (N, 3) float32 in 0..1 and which points are visible, (N,) bool."""
    color = np.zeros((len(samples.score), 3), np.float32)
    _blend(samples.score, samples.color, color)
    return color, samples.score[:, 0] > 0


@kernel(parallel=True)
def _blend(scores, colors, out):
    block = 1024
    for b in prange((scores.shape[0] + block - 1) // block):
        weights = np.empty(KEPT)
        order = np.empty(KEPT, np.int64)
        middle = np.empty(3)
        for n in range(b * block, min((b + 1) * block, scores.shape[0])):
            if scores[n, 0] <= 0.0:
                continue
            # Subtract the weight of the best photo that is left out, so that colors are continuous across the surface.
            floor = (scores[n, KEPT] / scores[n, 0]) ** _SHARPNESS
            count = 0
            total = 0.0
            for k in range(KEPT):
                if scores[n, k] > 0.0:
                    weights[k] = max((scores[n, k] / scores[n, 0]) ** _SHARPNESS - floor, 1e-6)
                    total += weights[k]
                    count += 1
            if count > 2:
                for c in range(3):
                    for k in range(count):
                        at = k
                        while at > 0 and colors[n, order[at - 1], c] > colors[n, k, c]:
                            order[at] = order[at - 1]
                            at -= 1
                        order[at] = k
                    half = 0.0
                    for k in range(count):
                        half += weights[order[k]]
                        if 2.0 * half >= total:
                            middle[c] = colors[n, order[k], c]
                            break
                for k in range(count):
                    away = 0.0
                    for c in range(3):
                        away = max(away, abs(colors[n, k, c] - middle[c]) / (255.0 * _ODD))
                    weights[k] *= max(np.exp(-away * away), 1e-6)
            total = 0.0
            for k in range(count):
                total += weights[k]
            for c in range(3):
                value = 0.0
                for k in range(count):
                    value += weights[k] * colors[n, k, c]
                out[n, c] = value / (255.0 * total)
