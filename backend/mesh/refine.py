"""Refinement of a surface by multi-view stereo in a thin layer around it.

For each vertex, several positions along its normal are tested. A patch around it is sampled from the photos that show
it best; at the correct position they agree. The offsets are averaged over neighbors, weighted by their confidence,
which also moves vertices in areas without texture. Each vertex then takes the median of the offsets around it, as a few
patches agree at wrong positions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numba import prange
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import cg

from ..raster.kernel import kernel
from ..shared.events import Reporter
from .surface import Surface, neighbors, vertex_normals, without_folds
from .texture.photos import Photo, Photos, look
from .views import Views

_ROUNDS = ((2.5, 11), (1.5, 9), (1.0, 9))
"""Largest offset of a vertex in each round, in pixel sizes on the surface, and number of positions that are tested."""

_OF_EXTENT = 1 / 36
_LEAST = 0.1
"""Largest offset, relative to the diagonal of the surface's bounding box, as small pictures show few details to match,
but at least so many pixel sizes."""

_PHOTOS = 6
_PATCH = 5
"""Number of photos of a patch; number of its rows and columns, one pixel apart."""

_OUTSIDE = 1.0
"""Clearance in pixels up to which a pixel may show something other than the surface."""

_AT_ONCE = 450_000
"""Number of positions whose patches are sampled together."""

_NONE = 255
_NOISE = (2.5 / 255) ** 2
_STIFFNESS = 3.0
_DAMPING = 0.05
_SHARED = 1
"""Number of rounds in which the costs of patches are averaged over neighbors."""

_AROUND = 3.0
"""Distance in pixel sizes up to which vertices are among those whose median offset a vertex takes."""
_MOST_AROUND = 128
_BLOCK = 2048
"""Largest number of vertices in a median; number of vertices whose medians are computed one after another."""


def refine(surface: Surface, views: Views, classes: Sequence[int], reporter: Reporter | None = None) -> Surface:
    """Move the vertices of a surface along their normals, by at most a few pixels, to positions where the photos agree.

    Args:
        surface: The surface in scene units.
        views: The training views.
        classes: The class indices of the surface's objects.
        reporter: Receives the progress.

    Returns:
        The surface with moved vertices and the same faces.
    """
    if not len(surface.faces):
        return surface
    reporter = reporter or Reporter()
    for step in range(len(_ROUNDS)):
        surface = replace(surface, vertices=_moved(surface, views, classes, reporter, step))
    return surface


def _moved(surface: Surface, views: Views, classes: Sequence[int], reporter: Reporter, step: int) -> np.ndarray:
    """Return the vertices of a surface after a round of refinement."""
    most, samples = _ROUNDS[step]
    photos = Photos(views, surface.vertices, surface.faces, classes)
    vertices, faces = photos.vertices, photos.faces
    near = neighbors(vertices, faces)
    mean = (diags(1 / np.maximum(np.asarray(near.sum(1)).ravel(), 1e-30)) @ near).tocsr()
    normals = vertex_normals(vertices, faces)
    for _ in range(5):
        normals = normals + mean @ normals
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    count = len(vertices)
    score = np.zeros((count, _PHOTOS), np.float32)
    chosen = np.full((count, _PHOTOS), -1, np.int32)
    size = np.zeros(count)
    at_once = _AT_ONCE // samples
    blocks = [slice(first, first + at_once) for first in range(0, count, at_once)]
    of_round = (1 + len(blocks)) * len(views.indices)
    done, total = of_round * step, of_round * len(_ROUNDS)
    for index in views.indices:
        reporter.progress(done, total)
        done += 1
        photo = photos[index]
        if photo is not None:
            _choose(vertices, normals, index, *_seen_by(photo), photo.safe, score, chosen, size)
    known = size > 0
    pixel = np.where(known, size, np.median(size[known]) if known.any() else 0.0)
    extent = np.linalg.norm(np.ptp(vertices, axis=0)) / max(float(np.median(pixel)), 1e-30)
    reach = min(most, max(float(_OF_EXTENT * extent), _LEAST))
    offsets = np.linspace(-reach, reach, samples)
    cost = np.empty((count, samples))
    for block in blocks:
        patches = np.full((len(cost[block]), _PHOTOS, samples, _PATCH * _PATCH, 3), _NONE, np.uint8)
        for index in views.indices:
            reporter.progress(done, total)
            done += 1
            if not (chosen[block] == index).any():
                continue
            photo = photos[index]
            assert photo is not None
            _look_up(
                vertices[block], normals[block], pixel[block], offsets, chosen[block], index, *_seen_by(photo),
                photo.planes, (photo.x, photo.y), patches,
            )  # fmt: skip
        _disagreement(patches, cost[block])
    settled = np.empty(count)
    _medians(_settled(cost, offsets, near), vertices, _AROUND * pixel, near.indptr, near.indices, settled)
    displacement = (settled * pixel)[:, None] * normals
    return vertices + without_folds(vertices, faces, displacement)


def _seen_by(photo: Photo) -> tuple[np.ndarray, ...]:
    viewmat, intrinsics = photo.camera.arrays()
    return photo.camera.center, viewmat, intrinsics, photo.depth, photo.clearance


def _settled(cost: np.ndarray, offsets: np.ndarray, near: csr_matrix) -> np.ndarray:
    """Compute the offset of each vertex, (V,) in pixels.

    cost (V, P): disagreement of the vertex's patches at `offsets` (P,), NaN if unknown; near: adjacency
    matrix of the vertices.
    """
    ties = np.maximum(np.asarray(near.sum(1)).ravel(), 1e-30)
    mean = diags(1 / ties) @ near
    known = np.isfinite(cost).all(1).astype(np.float64)
    shared, weight = np.where(known[:, None] > 0, cost, 0), known
    for _ in range(_SHARED):
        shared, weight = shared + mean @ shared, weight + mean @ weight
    cost = shared / np.maximum(weight, 1e-30)[:, None]
    best = np.clip(cost.argmin(1), 1, len(offsets) - 2)
    row = np.arange(len(cost))
    before, at, after = cost[row, best - 1], cost[row, best], cost[row, best + 1]
    bend = np.maximum(before - 2 * at + after, 1e-12)
    spacing = offsets[1] - offsets[0]
    wanted = np.clip(offsets[best] + spacing * np.clip((before - after) / (2 * bend), -1, 1), offsets[0], offsets[-1])
    sure = np.where(weight > 0, np.minimum(bend / (spacing**2 * (np.minimum(at, cost.min(1)) + _NOISE)), 10), 0)
    # sure (d - wanted) + damping d + stiffness (d - mean of the neighbors' d) = 0, times `ties` for a symmetric matrix.
    diagonal = ties * (sure + _DAMPING + _STIFFNESS)
    system = diags(diagonal) - _STIFFNESS * near
    solved, _ = cg(system, ties * sure * wanted, rtol=1e-4, maxiter=300, M=diags(1 / diagonal))
    return np.clip(solved, offsets[0], offsets[-1])


@kernel(parallel=True)
def _medians(values, vertices, reach, starts, others, medians):
    """Write to medians (V,) those of the values (V,) within `reach` (V,) of each vertex, along the surface.

    starts (V + 1,), others: the vertices to which edges lead from vertex n are others[starts[n]:starts[n + 1]].
    """
    count = vertices.shape[0]
    for block in prange((count + _BLOCK - 1) // _BLOCK):
        seen_by = np.full(count, -1, np.int32)
        around = np.empty(_MOST_AROUND, np.int32)
        for n in range(block * _BLOCK, min((block + 1) * _BLOCK, count)):
            around[0] = n
            seen_by[n] = n
            found, at = 1, 0
            while at < found:
                for edge in range(starts[around[at]], starts[around[at] + 1]):
                    other = others[edge]
                    if seen_by[other] == n or found == _MOST_AROUND:
                        continue
                    seen_by[other] = n
                    square = 0.0
                    for axis in range(3):
                        square += (vertices[other, axis] - vertices[n, axis]) ** 2
                    if square <= reach[n] ** 2:
                        around[found] = other
                        found += 1
                at += 1
            medians[n] = np.median(values[around[:found]])


@kernel(parallel=True)
def _choose(vertices, normals, index, camera_center, viewmat, intrinsics, depth, clearance, safe, scores, chosen, size):
    for n in prange(vertices.shape[0]):
        last = scores.shape[1] - 1
        score, _u, _v, _clear = look(
            vertices, normals, n, scores[n, last], camera_center, viewmat, intrinsics, depth, clearance, safe
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
    vertices,
    normals,
    pixel,
    offsets,
    chosen,
    index,
    _camera_center,
    viewmat,
    intrinsics,
    depth,
    clearance,
    planes,
    corner,
    patches,
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
        # Two tangents orthogonal to the normal (Duff et al. 2017).
        sign = 1.0 if nz >= 0.0 else -1.0
        a = -1.0 / (sign + nz)
        b = nx * ny * a
        tx, ty, tz = 1.0 + sign * nx * nx * a, sign * b, -sign * nx
        sx, sy, sz = b, sign + ny * ny * a, -ny
        for sample in range(offsets.size):
            for p in range(_PATCH * _PATCH):
                s = (p % _PATCH - _PATCH // 2) * pixel[n]
                t = (p // _PATCH - _PATCH // 2) * pixel[n]
                d = offsets[sample] * pixel[n]
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
                    patches[n, slot, sample, p, c] = int(min(max(value * 254.0 + 0.5, 0.0), 254.0))


@kernel(parallel=True)
def _disagreement(patches, cost):
    """Write to cost (V, P) the variance over the photos of colors in 0..1, averaged over the patch.

    NaN where too little is visible.
    """
    count, photos, samples, points, _ = patches.shape
    for n in prange(count):
        for sample in range(samples):
            total = 0.0
            seen = 0
            for p in range(points):
                for c in range(3):
                    mean = 0.0
                    square = 0.0
                    many = 0
                    for k in range(photos):
                        if patches[n, k, sample, p, c] != _NONE:
                            value = patches[n, k, sample, p, c] / 254.0
                            mean += value
                            square += value * value
                            many += 1
                    if many >= 2:
                        mean /= many
                        total += max(square / many - mean * mean, 0.0) * many / (many - 1)
                        seen += 1
            cost[n, sample] = total / seen if 2 * seen >= 3 * points else np.nan
