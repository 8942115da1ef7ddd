"""A surface moved to where the photographs agree about it: multi-view stereo in a thin layer around it.

Each vertex tries places along its normal. A patch around it is looked up in the photos that show it best; where the
surface is right they show the same. What the patches say is averaged over their neighbours, as their confidence
deserves, and so carried on to where the photos show no texture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numba import prange
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import cg

from .. import device
from ..protocol import Reporter
from ..raster.kernel import kernel
from .photos import Photo, look, photo_of
from .surface import Surface, vertex_normals
from .texture import neighbours
from .views import Views

_REACHES = (1.5, 1.0)
"""How far a vertex may move in each round, in pixels' sizes on it."""

_PHOTOS = 6
_PLACES = 9
_PATCH = 5
"""Places tried, over twice the reach; rows and columns of a patch, a pixel's size apart."""

_OUTSIDE = 1.0
"""Clearance below which a pixel may show another thing."""

_AT_ONCE = 50_000
_HELD = 300e6
"""Vertices whose patches are looked up together, and bytes of the photos' depths that are kept meanwhile."""

_NONE = 255
_NOISE = (2.5 / 255) ** 2
_STIFFNESS = 3.0
_STAY = 0.05
_TURN = 0.5
"""Cosine of the angle by which a face may turn."""

_UNFOLDED = 40
_SHARED = 3
"""Rounds in which neighbours average what their patches say."""


def refine(surface: Surface, views: Views, classes: Sequence[int], reporter: Reporter | None = None) -> Surface:
    """The surface (scene units) with its vertices moved along their normals, by a few pixels' sizes at most."""
    reporter = reporter or Reporter()
    for step, reach in enumerate(_REACHES):
        surface = replace(surface, vertices=_moved(surface, views, classes, reach, reporter, step))
    return surface


def _moved(
    surface: Surface, views: Views, classes: Sequence[int], reach: float, reporter: Reporter, step: int
) -> np.ndarray:
    vertices = np.ascontiguousarray(surface.vertices, np.float64)
    faces = np.ascontiguousarray(surface.faces, np.int32)
    near = neighbours(vertices, faces)
    mean = (diags(1 / np.maximum(np.asarray(near.sum(1)).ravel(), 1e-30)) @ near).tocsr()
    normals = vertex_normals(vertices, faces)
    for _ in range(5):
        normals = normals + mean @ normals
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    count = len(vertices)
    score = np.zeros((count, _PHOTOS), np.float32)
    chosen = np.full((count, _PHOTOS), -1, np.int32)
    size = np.zeros(count)
    blocks = [slice(first, first + _AT_ONCE) for first in range(0, count, _AT_ONCE)]
    rounds = 1 + len(blocks)
    total = rounds * len(views.indices) * len(_REACHES)
    done = rounds * len(views.indices) * step
    held: dict[int, Photo | None] = {}
    room = float(_HELD)
    for index in views.indices:
        reporter.progress(done, total)
        done += 1
        photo = photo_of(views, index, vertices, faces, classes)
        if photo is not None:
            _choose(vertices, normals, index, *_seen_by(photo), photo.safe, score, chosen, size)
            # The planes are the scene's to keep.
            photo = photo._replace(planes=np.zeros((0, 0, 0), np.float32))
            room -= photo.depth.nbytes + photo.clearance.nbytes
        if room > 0:
            held[index] = photo
    known = size > 0
    pixel = np.where(known, size, np.median(size[known]) if known.any() else 0.0)
    away = np.linspace(-reach, reach, _PLACES)
    cost = np.empty((count, _PLACES))
    for block in blocks:
        patches = np.full((len(cost[block]), _PHOTOS, _PLACES, _PATCH * _PATCH, 3), _NONE, np.uint8)
        for index in views.indices:
            reporter.progress(done, total)
            done += 1
            if not (chosen[block] == index).any():
                continue
            photo = held[index] if index in held else photo_of(views, index, vertices, faces, classes)
            assert photo is not None
            planes = device.host(views.scene.target(index)[0])
            _look_up(
                vertices[block], normals[block], pixel[block], away, chosen[block], index, *_seen_by(photo), planes,
                (photo.x, photo.y), patches,
            )  # fmt: skip
        _disagreement(patches, cost[block])
    way = (_settled(cost, away, near) * pixel)[:, None] * normals
    return vertices + _without_folds(vertices, faces, way, mean)


def _without_folds(vertices: np.ndarray, faces: np.ndarray, way: np.ndarray, mean: csr_matrix) -> np.ndarray:
    """`way` (V, 3), which the vertices go, smoothed wherever faces would turn over."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    before = np.cross(b - a, c - a)
    even = mean.copy()
    even.data = 1 / np.repeat(np.maximum(np.diff(even.indptr), 1), np.diff(even.indptr))
    for round in range(_UNFOLDED):
        a, b, c = np.moveaxis((vertices + way)[faces], 1, 0)
        after = np.cross(b - a, c - a)
        least = _TURN * np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
        folded = (before * after).sum(1) < least
        if not folded.any():
            break
        near = np.zeros(len(vertices))
        near[faces[folded]] = 1
        for _ in range(1 + round // 4):
            near = near + even @ near
        way = np.where(near[:, None] > 0, (way + even @ way) / 2, way)
    return way


def _seen_by(photo: Photo) -> tuple[np.ndarray, ...]:
    viewmat, intrinsics = photo.camera.arrays()
    return photo.camera.centre, viewmat, intrinsics, photo.depth, photo.clearance


def _settled(cost: np.ndarray, away: np.ndarray, near: csr_matrix) -> np.ndarray:
    """How far each vertex moves, (V,) in pixels' sizes, from the patches' disagreement (V, P) at the places `away`;
    NaN: not known."""
    ties = np.maximum(np.asarray(near.sum(1)).ravel(), 1e-30)
    mean = diags(1 / ties) @ near
    known = np.isfinite(cost).all(1).astype(np.float64)
    shared, weight = np.where(known[:, None] > 0, cost, 0), known
    for _ in range(_SHARED):
        shared, weight = shared + mean @ shared, weight + mean @ weight
    cost = shared / np.maximum(weight, 1e-30)[:, None]
    best = np.clip(cost.argmin(1), 1, len(away) - 2)
    row = np.arange(len(cost))
    before, at, after = cost[row, best - 1], cost[row, best], cost[row, best + 1]
    bend = np.maximum(before - 2 * at + after, 1e-12)
    spacing = away[1] - away[0]
    wanted = np.clip(away[best] + spacing * np.clip((before - after) / (2 * bend), -1, 1), away[0], away[-1])
    sure = np.where(weight > 0, np.minimum(bend / (spacing**2 * (np.minimum(at, cost.min(1)) + _NOISE)), 10), 0)
    # sure (d - wanted) + stay d + stiffness (d - mean of the neighbours' d) = 0, times `ties`: symmetric.
    diagonal = ties * (sure + _STAY + _STIFFNESS)
    system = diags(diagonal) - _STIFFNESS * near
    solved, _ = cg(system, ties * sure * wanted, rtol=1e-4, maxiter=300, M=diags(1 / diagonal))
    return np.clip(solved, away[0], away[-1])


@kernel(parallel=True)
def _choose(vertices, normals, index, eye, viewmat, intrinsics, depth, clearance, safe, scores, chosen, size):
    for n in prange(vertices.shape[0]):
        last = scores.shape[1] - 1
        score, _u, _v, _clear = look(
            vertices, normals, n, scores[n, last], eye, viewmat, intrinsics, depth, clearance, safe
        )
        if score <= scores[n, last]:
            continue
        at = last
        while at > 0 and scores[n, at - 1] < score:
            scores[n, at] = scores[n, at - 1]
            chosen[n, at] = chosen[n, at - 1]
            at -= 1
        scores[n, at] = score
        chosen[n, at] = index
        if at == 0:
            z = viewmat[2, 3]
            for axis in range(3):
                z += viewmat[2, axis] * vertices[n, axis]
            size[n] = 2 * z / (intrinsics[0] + intrinsics[1])


@kernel(parallel=True)
def _look_up(
    vertices, normals, pixel, away, chosen, index, eye, viewmat, intrinsics, depth, clearance, planes, corner, patches
):
    fx, fy, cx, cy = intrinsics
    height, width = depth.shape
    for n in prange(vertices.shape[0]):
        slot = -1
        for k in range(chosen.shape[1]):
            if chosen[n, k] == index:
                slot = k
        if slot < 0:
            continue
        nx, ny, nz = normals[n, 0], normals[n, 1], normals[n, 2]
        # Two directions across the normal (Duff et al. 2017).
        sign = 1.0 if nz >= 0.0 else -1.0
        a = -1.0 / (sign + nz)
        b = nx * ny * a
        tx, ty, tz = 1.0 + sign * nx * nx * a, sign * b, -sign * nx
        sx, sy, sz = b, sign + ny * ny * a, -ny
        for place in range(away.size):
            for p in range(_PATCH * _PATCH):
                s = (p % _PATCH - _PATCH // 2) * pixel[n]
                t = (p // _PATCH - _PATCH // 2) * pixel[n]
                d = away[place] * pixel[n]
                x = vertices[n, 0] + d * nx + s * sx + t * tx
                y = vertices[n, 1] + d * ny + s * sy + t * ty
                z = vertices[n, 2] + d * nz + s * sz + t * tz
                pz = viewmat[2, 0] * x + viewmat[2, 1] * y + viewmat[2, 2] * z + viewmat[2, 3]
                if pz <= 0.0:
                    continue
                px = viewmat[0, 0] * x + viewmat[0, 1] * y + viewmat[0, 2] * z + viewmat[0, 3]
                py = viewmat[1, 0] * x + viewmat[1, 1] * y + viewmat[1, 2] * z + viewmat[1, 3]
                u = px / pz * fx + cx - 0.5
                v = py / pz * fy + cy - 0.5
                if not (u >= 0.0 and v >= 0.0 and u < width - 1 and v < height - 1):
                    continue
                column, row = int(u), int(v)
                fu, fv = u - column, v - row
                if clearance[row + int(fv + 0.5), column + int(fu + 0.5)] <= _OUTSIDE:
                    continue
                column += corner[0]
                row += corner[1]
                for c in range(3):
                    value = (planes[c, row, column] * (1 - fu) + planes[c, row, column + 1] * fu) * (1 - fv) + (
                        planes[c, row + 1, column] * (1 - fu) + planes[c, row + 1, column + 1] * fu
                    ) * fv
                    patches[n, slot, place, p, c] = int(min(max(value * 254.0 + 0.5, 0.0), 254.0))


@kernel(parallel=True)
def _disagreement(patches, cost):
    """Variance over the photos, of colours in 0..1, mean over the patch: cost (V, P); NaN where too little is seen."""
    count, photos, places, points, _ = patches.shape
    for n in prange(count):
        for place in range(places):
            total = 0.0
            seen = 0
            for p in range(points):
                for c in range(3):
                    mean = 0.0
                    square = 0.0
                    many = 0
                    for k in range(photos):
                        if patches[n, k, place, p, c] != _NONE:
                            value = patches[n, k, place, p, c] / 254.0
                            mean += value
                            square += value * value
                            many += 1
                    if many >= 2:
                        mean /= many
                        total += max(square / many - mean * mean, 0.0) * many / (many - 1)
                        seen += 1
            cost[n, place] = total / seen if 2 * seen >= 3 * points else np.nan
