"""More points where features are few: plane sweep over small patches of the photos, with known poses.

COLMAP's points are corners of textures, so plain floors and walls have hardly any, and training has nothing to start
from there. Here the pixels of a coarse grid of each photo try depths; the one at which the patches of the neighboring
photos correlate best is kept if it is distinct and other photos find it, too.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numba
import numpy as np
from PIL import Image as PilImage

from ..capture import Capture, View

GRID = 6000
"""Number of pixels of each photo that are tried."""
LONGEST_SIDE = 640
"""Side in pixels to which larger photos are scaled."""
DEPTHS = 128
NEIGHBORS = 8
RADIUS = 4
"""Radius of the patches in pixels."""
CORRELATES = 0.6
"""Least normalized correlation, the mean of the two best neighbors."""
DISTINCT = 0.01
"""Least lead over the correlation at depths that are not near the best one."""
AGREES = 0.015
"""Largest relative difference of the depth that another photo finds."""
FEWEST = 2
"""Number of other photos that find the depth, too."""
_NEAREST_FARTHEST = 5, 99
_NEARER, _FARTHER = 0.6, 1.5
"""Percentiles of the depths of COLMAP's points in a view, and the range of depths relative to them."""
_ANGLES = 0.05, 0.7
"""Range of the angles in radians between neighboring photos, as seen from the scene."""
_FLATTEST = 1.5
"""Least standard deviation of a patch in gray levels."""
_BESIDE = 3
"""Number of depths on each side of the best one that are near it."""


class _Sweep(NamedTuple):
    """Depths found in a view: pixels (n, 2) in the scaled photo, depths (n,), and shape (rows, columns) of the grid.

    Depths are 0 where none was found. K is that of the scaled photo.
    """

    pixels: np.ndarray
    depths: np.ndarray
    shape: tuple[int, int]
    stride: int
    K: np.ndarray


def dense_points(
    capture: Capture, progress: Callable[[int, int], None] = lambda _done, _total: None
) -> tuple[np.ndarray, np.ndarray]:
    """Find points on surfaces that the photos of a capture show.

    Args:
        capture: the capture; must be prepared.
        progress: called with the number of photos done, and of all.

    Returns:
        xyz (n, 3) float64 and rgb (n, 3) uint8.
    """
    views = list(range(len(capture.views)))
    scaled = [_gray(capture, index) for index in views]
    neighbors = _neighbors(capture)
    sweeps: list[_Sweep | None] = []
    for index in views:
        progress(index, len(views))
        sweeps.append(_sweep(capture, scaled, index, neighbors[index]))
    found, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    for index, sweep in enumerate(sweeps):
        if sweep is None:
            continue
        view = capture.views[index]
        good = np.flatnonzero(sweep.depths > 0)
        rays = np.column_stack([sweep.pixels[good] + 0.5, np.ones(len(good))]) @ np.linalg.inv(sweep.K).T
        local = rays * sweep.depths[good, None]
        world = (local - view.viewmat[:3, 3]) @ view.viewmat[:3, :3]
        agreed = np.zeros(len(good), int)
        for other in neighbors[index]:
            agreed += _agrees(capture, sweeps[other], other, world)
        keep = agreed >= FEWEST
        image, factor = capture.image(index), scaled[index][1]
        at = np.clip((sweep.pixels[good][keep] / factor).astype(int), 0, [view.width - 1, view.height - 1])
        found.append(world[keep])
        colors.append(image[at[:, 1], at[:, 0]])
    return np.concatenate(found), np.concatenate(colors)


def spacing(capture: Capture) -> float:
    """Return the typical distance between the points of neighboring pixels of the grid."""
    sizes: list[float] = []
    for view in capture.views:
        depths = capture.points.xyz @ view.viewmat[2, :3] + view.viewmat[2, 3]
        if (depths > 0).any():
            sizes.append(np.median(depths[depths > 0]) / view.K[0, 0] * np.sqrt(view.width * view.height / GRID))
    return float(np.median(sizes)) if sizes else 1.0


def thinned(xyz: np.ndarray, known: np.ndarray, size: float) -> np.ndarray:
    """Return the indices of points (n, 3), at most one in each cube of a side, and none where a known one (m, 3) is."""
    cells = np.floor(np.concatenate([known, xyz]) / size).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return np.sort(first[first >= len(known)]) - len(known)


def _gray(capture: Capture, index: int) -> tuple[np.ndarray, float]:
    """Return a photo in gray (h, w), scaled down if it is large, and the factor."""
    image = PilImage.fromarray(capture.image(index)).convert("F")
    factor = min(1.0, LONGEST_SIDE / max(image.size))
    if factor < 1.0:
        image = image.resize([max(round(side * factor), 1) for side in image.size], PilImage.Resampling.BOX)
    return np.asarray(image, np.float32), factor


def _neighbors(capture: Capture) -> list[list[int]]:
    """Return, for each view, the views that show the same from a little aside."""
    matrices = np.array([view.viewmat for view in capture.views])
    centers = -np.einsum("nij,ni->nj", matrices[:, :3, :3], matrices[:, :3, 3])
    axes = matrices[:, 2, :3]
    found = []
    for index, matrix in enumerate(matrices):
        depths = capture.points.xyz @ matrix[2, :3] + matrix[2, 3]
        subject = centers[index] + axes[index] * (np.median(depths[depths > 0]) if (depths > 0).any() else 1.0)
        rays = centers - subject
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles = np.arccos(np.clip(rays @ rays[index], -1.0, 1.0))
        usable = (angles > _ANGLES[0]) & (angles < _ANGLES[1]) & (axes @ axes[index] > 0.5)
        order = np.argsort(np.where(usable, angles, np.inf), kind="stable")
        found.append([int(other) for other in order[:NEIGHBORS] if usable[other]])
    return found


def _sweep(capture: Capture, scaled: list, index: int, neighbors: list[int]) -> _Sweep | None:
    """Find the depths of the grid's pixels in a view; None without neighbors or points."""
    image = scaled[index][0]
    view, (height, width) = capture.views[index], image.shape
    matrix, K = view.viewmat, _scaled_intrinsics(view, image)
    known = capture.points.xyz @ matrix[2, :3] + matrix[2, 3]
    if not neighbors or not (known > 0).any():
        return None
    near, far = np.percentile(known[known > 0], _NEAREST_FARTHEST) * (_NEARER, _FARTHER)
    stride = max(int(np.ceil(np.sqrt(height * width / GRID))), 1)
    rows, columns = (np.arange(RADIUS, side - RADIUS, stride) for side in (height, width))
    pixels = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    offsets = np.stack(np.meshgrid(*[np.arange(-RADIUS, RADIUS + 1)] * 2), -1)
    patches = pixels[:, None, None] + offsets
    values = image[patches[..., 1], patches[..., 0]]
    textured = np.flatnonzero(values.std((1, 2)) >= _FLATTEST)
    inverse_K = np.linalg.inv(K)
    rays = np.column_stack([pixels[textured] + 0.5, np.ones(len(textured))]) @ inverse_K.T
    depths = 1.0 / np.linspace(1.0 / far, 1.0 / near, DEPTHS)
    between = np.array([capture.views[other].viewmat for other in neighbors]) @ np.linalg.inv(matrix)
    theirs = np.array([_scaled_intrinsics(capture.views[other], scaled[other][0]) for other in neighbors])
    sizes = np.array([scaled[other][0].shape for other in neighbors])
    images = np.zeros((len(neighbors), *sizes.max(0)), np.float32)
    for number, other in enumerate(neighbors):
        images[number, : sizes[number, 0], : sizes[number, 1]] = scaled[other][0]
    score = _scores(
        values[textured], rays.astype(np.float32), inverse_K.T[:2].astype(np.float32), depths.astype(np.float32),
        (theirs @ between[:, :3, :3]).astype(np.float32),
        np.einsum("nij,nj->ni", theirs, between[:, :3, 3]).astype(np.float32), images, sizes,
    )  # fmt: skip
    best = score.argmax(1)
    top = score[np.arange(len(score)), best]
    aside = np.abs(np.arange(DEPTHS)[None] - best[:, None]) > _BESIDE
    second = np.where(aside, score, -1.0).max(1)
    good = (top >= CORRELATES) & (top - second >= DISTINCT)
    good &= (best > 0) & (best < DEPTHS - 1)
    inner = np.clip(best, 1, DEPTHS - 2)
    left, middle, right = (score[np.arange(len(score)), inner + step] for step in (-1, 0, 1))
    bend = left - 2 * middle + right
    shift = np.where(bend < -1e-6, 0.5 * (left - right) / np.minimum(bend, -1e-6), 0.0).clip(-0.5, 0.5)
    inverse = np.interp(inner + shift, np.arange(DEPTHS), 1.0 / depths)
    found = np.zeros(len(pixels))
    found[textured[good]] = 1.0 / inverse[good]
    return _Sweep(pixels, found, (len(rows), len(columns)), stride, K)


@numba.njit(parallel=True, cache=True, nogil=True, fastmath=True)
def _scores(values, rays, beside, depths, turns, steps, images, sizes):  # type: ignore[no-untyped-def]
    """Return the mean of the two best correlations of each patch with other photos at each depth, (n, d) float32.

    A patch is small, so its projection is taken as affine.

    Args:
        values: (n, side, side) float32 gray levels of the patches.
        rays: (n, 3) float32 rays of the middle pixels, with depth 1.
        beside: (2, 3) float32, difference of the ray of the next pixel to the right, and of the one below.
        depths: (d,) float32.
        turns: (k, 3, 3) float32, and steps (k, 3): a ray times its depth, to the other photos' pixels times depth.
        images: (k, H, W) float32 gray levels; sizes: (k, 2) heights and widths that are used of them.
    """
    count, side = values.shape[:2]
    radius, pixels, edge = side // 2, side * side, np.float32(0.01)
    scores = np.empty((count, len(depths)), np.float32)
    for n in numba.prange(count):
        mean, square = 0.0, 0.0
        for i in range(side):
            for j in range(side):
                mean += values[n, i, j]
                square += values[n, i, j] * values[n, i, j]
        mean /= pixels
        own = np.sqrt(max(square / pixels - mean * mean, 1e-6))
        middle = np.empty((len(turns), 3), np.float32)
        right, below = np.empty_like(middle), np.empty_like(middle)
        for k in range(len(turns)):
            for axis in range(3):
                middle[k, axis] = right[k, axis] = below[k, axis] = 0.0
                for other in range(3):
                    middle[k, axis] += turns[k, axis, other] * rays[n, other]
                    right[k, axis] += turns[k, axis, other] * beside[0, other]
                    below[k, axis] += turns[k, axis, other] * beside[1, other]
        for d in range(len(depths)):
            first, second = np.float32(-1.0), np.float32(-1.0)
            for k in range(len(turns)):
                z = middle[k, 2] * depths[d] + steps[k, 2]
                if z <= 0.0:
                    continue
                u = (middle[k, 0] * depths[d] + steps[k, 0]) / z
                v = (middle[k, 1] * depths[d] + steps[k, 1]) / z
                scale = depths[d] / z
                ux, uy = scale * (right[k, 0] - u * right[k, 2]), scale * (below[k, 0] - u * below[k, 2])
                vx, vy = scale * (right[k, 1] - v * right[k, 2]), scale * (below[k, 1] - v * below[k, 2])
                height, width = sizes[k]
                across, down = radius * (abs(ux) + abs(uy)), radius * (abs(vx) + abs(vy))
                u, v = u - np.float32(0.5), v - np.float32(0.5)
                if min(u - across, v - down) < edge or u + across > width - 1 - edge or v + down > height - 1 - edge:
                    continue
                total, squares, product = np.float32(0.0), np.float32(0.0), np.float32(0.0)
                for i in range(side):
                    x = u - radius * ux + (i - radius) * uy
                    y = v - radius * vx + (i - radius) * vy
                    for j in range(side):
                        column, row = int(x), int(y)
                        a, b = x - column, y - row
                        upper = images[k, row, column] + a * (images[k, row, column + 1] - images[k, row, column])
                        lower = images[k, row + 1, column] + a * (
                            images[k, row + 1, column + 1] - images[k, row + 1, column]
                        )
                        seen = upper + b * (lower - upper)
                        total += seen
                        squares += seen * seen
                        product += seen * (values[n, i, j] - mean)
                        x += ux
                        y += vx
                other_square = squares / pixels - (total / pixels) ** 2
                if other_square > 0.25:
                    correlation = np.float32(product / pixels / (own * np.sqrt(other_square)))
                    if correlation > first:
                        first, second = correlation, first
                    elif correlation > second:
                        second = correlation
            scores[n, d] = 0.5 * (first + second) if len(turns) > 1 else first
    return scores


def _agrees(capture: Capture, sweep: _Sweep | None, other: int, world: np.ndarray) -> np.ndarray:
    """Return whether another view finds points (n, 3) at their depths, (n,) int."""
    if sweep is None:
        return np.zeros(len(world), int)
    matrix = capture.views[other].viewmat
    local = world @ matrix[:3, :3].T + matrix[:3, 3]
    depth = np.maximum(local[:, 2], 1e-9)
    at = (local @ sweep.K.T)[:, :2] / depth[:, None]
    cell = np.round((at - 0.5 - RADIUS) / sweep.stride).astype(np.int64)
    rows, columns = sweep.shape
    inside = (cell >= 0).all(1) & (cell[:, 0] < columns) & (cell[:, 1] < rows) & (local[:, 2] > 0)
    grid = sweep.depths.reshape(rows, columns)
    there = np.zeros(len(world))
    there[inside] = grid[cell[inside, 1], cell[inside, 0]]
    return ((there > 0) & (np.abs(there - depth) < AGREES * depth)).astype(int)


def _scaled_intrinsics(view: View, image: np.ndarray) -> np.ndarray:
    height, width = image.shape
    return np.diag([width / view.width, height / view.height, 1.0]) @ view.K
