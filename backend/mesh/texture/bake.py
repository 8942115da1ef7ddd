"""Baking of the photos into the texture and vertex colors of a surface."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import diags
from scipy.sparse.linalg import cg

from ...raster.camera import Camera
from ...raster.kernel import kernel
from ...shared.events import Reporter
from ..surface import Surface, neighbors, vertex_normals
from ..views import Views
from .atlas import Texels, fill, find_texels, interpolate
from .hidden import Textured, complete_hidden_parts
from .leveling import level
from .photos import Photo, Photos, Samples, add_photo, blend

SIZES = (512, 1024, 2048, 4096)

_USED = 0.5
"""Common fraction of a texture that is covered by charts; with long ones, it is much less."""

_AT_ONCE = 4_000_000
"""Largest number of texels that are processed together, to limit memory usage."""

_KNOWN = 1e-6
"""Smallest weight of a vertex's color."""
_SHOWN = 1.0
"""Weight from which on the color of splats replaces that of photos: one view from the front, or several at a slant."""

_EMPTY, _SEEN, _UNSEEN = 0, 1, 2
"""State of a texel: not on the surface; visible in a photo; on the surface, but visible in no photo."""


def texture_size(surface: Surface, views: Views, uvs: np.ndarray | None = None) -> int:
    """Choose the size of a texture.

    Args:
        surface: The surface in scene units.
        views: The training views.
        uvs: (F, 3, 2) from `unwrap`, for the fraction of the texture that they cover; None: a common one.

    Returns:
        The smallest of SIZES for which, on most of the surface, texels are not larger than pixels of the closest view.
    """
    vertices, faces = _arrays(surface)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1) / 2
    normal /= np.maximum(2 * area, 1e-30)[:, None]
    center = (a + b + c) / 3
    finest = np.zeros(len(faces))  # pixels per unit of area
    for index in views.indices:
        camera = views.scene.camera(index)
        pixels, depth = _project(center, camera)
        shown = (depth > camera.near) & ((pixels > 0) & (pixels < [camera.width, camera.height])).all(1)
        way = camera.center - center
        facing = (way * normal).sum(1) / np.maximum(np.linalg.norm(way, axis=1), 1e-30)
        density = camera.K[0, 0] * camera.K[1, 1] / np.maximum(depth, camera.near) ** 2 * np.maximum(facing, 0)
        finest = np.maximum(finest, np.where(shown, density, 0))
    seen = finest > 0
    if not seen.any():
        return SIZES[0]
    # The density that suffices for 80% of the seen area, applied to the whole surface.
    order = np.argsort(finest[seen])
    reached = np.cumsum(area[seen][order]) / max(float(area[seen].sum()), 1e-30)
    density = finest[seen][order][min(int(np.searchsorted(reached, 0.8)), len(order) - 1)]
    used = _USED
    if uvs is not None:
        along, away = np.moveaxis(uvs[:, 1:].astype(np.float64) - uvs[:, :1], 1, 0)
        used = max(float(np.abs(along[:, 0] * away[:, 1] - along[:, 1] * away[:, 0]).sum()) / 2, 1e-9)
    needed = np.sqrt(density * area.sum() / used)
    return next((size for size in SIZES if size >= needed), SIZES[-1])


def bake_texture(
    surface: Surface,
    uvs: np.ndarray,
    size: int,
    views: Views,
    classes: Sequence[int],
    reporter: Reporter | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Bake the photos into a texture.

    Each texel is blended from the photos that show it best. Texels that are visible in no photo get the colors of the
    splats there; where these are hardly seen, too, colors are extrapolated, and flat parts get the detail of their
    surroundings.

    Args:
        surface: The surface in scene units.
        uvs: (F, 3, 2) from `unwrap`.
        size: The width and height of the texture.
        views: The training views with their photos.
        classes: The class indices of the surface's objects.
        reporter: Receives the progress.

    Returns:
        The texture (size, size, 3) uint8 sRGB, top row first, and the vertex colors (V, 3) uint8 sRGB, taken from the
        splats.
    """
    reporter = reporter or Reporter()
    photos = Photos(views, surface.vertices, surface.faces, classes)
    vertices, faces = photos.vertices, photos.faces
    normals = vertex_normals(vertices, faces)
    texture = np.zeros((size, size, 3), np.uint8)
    state = np.zeros((size, size), np.uint8)
    splats = _Mean(len(vertices))
    photo_colors = _Mean(len(vertices))
    rows = max(1, _AT_ONCE // size)
    steps = [(first, min(rows, size - first)) for first in range(0, size, rows)]
    passes = (1 + len(steps)) * len(views.indices)
    no_offsets = np.zeros((len(vertices), 3), np.float32)
    shown, counts = np.zeros((2, len(faces)))
    offsets = level(photos, normals, lambda done: reporter.progress(done, passes))
    for step, (first, count) in enumerate(steps):
        texels = find_texels(uvs, size, first, count)
        positions = _on_faces(vertices, faces, texels)
        facing = _on_faces(normals, faces, texels)
        samples = Samples.none(len(texels.face))
        corners = faces[texels.face]
        for done, index in enumerate(views.indices):
            reporter.progress((step + 1) * len(views.indices) + done, passes)
            photo = photos[index]
            if photo is None:
                continue
            add_photo(photo, positions, facing, corners, texels.weights, offsets.get(index, no_offsets), samples)
            if step == 0:
                _add_splats(splats, photo, vertices, normals, views, index, classes)
        color, seen = blend(samples)
        texture.reshape(-1, 3)[texels.indices] = np.rint(color * 255)
        state.ravel()[texels.indices] = np.where(seen, _SEEN, _UNSEEN)
        counts += np.bincount(texels.face, minlength=len(faces))
        shown += np.bincount(texels.face, seen, len(faces))
        _add_texels(faces, texels.face, texels.weights, color, seen, photo_colors.total, photo_colors.weight)
    vertex_colors = _extrapolate(splats, vertices, faces, np.full(3, 0.5, np.float32))
    # What no photo may color, such as thin parts, has the color of its splats where these are seen.
    of_splats = (photo_colors.weight <= _KNOWN) & (splats.weight > _SHOWN)
    photo_colors.total[of_splats] = vertex_colors[of_splats]
    photo_colors.weight[of_splats] = 1
    base = _extrapolate(photo_colors, vertices, faces, vertex_colors)
    _continue_smoothly(texture, state, base, faces, uvs, steps)
    surface_of_texels = Textured(
        vertices, faces, np.where(counts > 0, shown / np.maximum(counts, 1), 1.0),
        lambda: (find_texels(uvs, size, first, count) for first, count in steps), int(counts.sum()),
    )  # fmt: skip
    complete_hidden_parts(
        texture, state == _SEEN, surface_of_texels, lambda done: reporter.progress(passes - 1 + done, passes)
    )
    _fill_between_charts(texture, state)
    return texture, np.rint(np.clip(vertex_colors, 0, 1) * 255).astype(np.uint8)


class _Mean:
    """Weighted sums of colors at vertices."""

    def __init__(self, count: int) -> None:
        self.total = np.zeros((count, 3))
        self.weight = np.zeros(count)


def _arrays(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    return np.ascontiguousarray(surface.vertices, np.float64), np.ascontiguousarray(surface.faces, np.int32)


def _project(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Project points (N, 3) to pixels (N, 2) and depth (N,); pixels are valid only where the depth is positive."""
    seen = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    depth = np.where(seen[:, 2] > 0, seen[:, 2], -1.0)
    return seen[:, :2] / depth[:, None] * [camera.K[0, 0], camera.K[1, 1]] + camera.K[:2, 2], depth


def _on_faces(values: np.ndarray, faces: np.ndarray, texels: Texels) -> np.ndarray:
    out = np.empty((len(texels.face), 3), np.float32)
    interpolate(values, faces, texels.face, texels.weights, out)
    return out


def _add_splats(
    mean: _Mean,
    photo: Photo,
    vertices: np.ndarray,
    normals: np.ndarray,
    views: Views,
    index: int,
    classes: Sequence[int],
) -> None:
    """Add the rendered colors of the objects' splats in view `index` to the vertices visible in it."""
    view = views.object_view(index, classes)
    if view is None:
        return
    way = photo.camera.center - vertices
    facing = (way * normals).sum(1) / np.maximum(np.linalg.norm(way, axis=1), 1e-30)
    pixels, depth = _project(vertices, photo.camera)
    column, row = np.floor(pixels).astype(np.int64).T
    seen = (facing > 0) & (depth > 0) & (column >= 0) & (row >= 0)
    seen &= (column < photo.depth.shape[1]) & (row < photo.depth.shape[0])
    at = np.flatnonzero(seen)
    nearest = photo.depth[row[at], column[at]]
    at = at[depth[at] <= nearest * 1.01]
    # The object view covers a different rectangle.
    column, row = column[at] + photo.x - view.x, row[at] + photo.y - view.y
    inside = (column >= 0) & (row >= 0) & (column < view.alpha.shape[1]) & (row < view.alpha.shape[0])
    at, column, row = at[inside], column[inside], row[inside]
    weight = facing[at] ** 2 * view.alpha[row, column] * (view.visible[row, column] + 1e-3)
    mean.total[at] += view.color[row, column] * weight[:, None]
    mean.weight[at] += weight


@kernel()
def _add_texels(faces, face, weights, color, seen, total, weight):
    for n in range(face.size):
        if seen[n]:
            for i in range(3):
                v = faces[face[n], i]
                w = max(weights[n, i], np.float32(0.0))
                weight[v] += w
                for c in range(3):
                    total[v, c] += w * color[n, c]


def _extrapolate(mean: _Mean, vertices: np.ndarray, faces: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Return colors (V, 3) float32: the means, extrapolated smoothly along the surface to vertices without one.

    otherwise: (3,) or (V, 3), the default colors if no vertex has a mean.
    """
    known = mean.weight > _KNOWN
    out = np.empty((len(vertices), 3), np.float32)
    out[:] = otherwise
    if not known.any():
        return out
    out[known] = mean.total[known] / mean.weight[known, None]
    out[~known] = out[known].mean(0)
    if known.all():
        return out
    near = neighbors(vertices, faces)
    mine = np.asarray(near.sum(1)).ravel()[~known]
    unknown = np.flatnonzero(~known)
    system = diags(np.maximum(mine, 1e-30)) - near[unknown][:, unknown]
    given = near[unknown][:, known] @ out[known]
    for c in range(3):
        solved, _ = cg(
            system, given[:, c], x0=out[unknown, c], rtol=1e-4, maxiter=300, M=diags(1 / np.maximum(mine, 1e-30))
        )
        out[unknown, c] = np.clip(solved, out[known, c].min(), out[known, c].max())
    return out


def _continue_smoothly(
    texture: np.ndarray, state: np.ndarray, base: np.ndarray, faces: np.ndarray, uvs: np.ndarray, steps: list
) -> None:
    """Color the texels that are visible in no photo, in place.

    Such a texel gets the color `base`, interpolated between the vertices, plus the smoothly extrapolated difference of
    the seen texels from it, to avoid visible seams.
    """
    size, unseen = len(state), state == _UNSEEN
    if not unseen.any():
        return
    smooth = np.zeros((size, size, 3), np.float32)
    for first, count in steps:
        texels = find_texels(uvs, size, first, count)
        smooth.reshape(-1, 3)[texels.indices] = _on_faces(base, faces, texels)
    difference = texture.astype(np.float32) / 255 - smooth
    fill(difference, state == _SEEN)
    texture[unseen] = np.rint(np.clip(smooth[unseen] + difference[unseen], 0, 1) * 255)


def _fill_between_charts(texture: np.ndarray, state: np.ndarray) -> None:
    """Color the texels that are on no chart, in place."""
    values = texture.astype(np.float32)
    fill(values, state != _EMPTY)
    np.rint(values, out=values)
    texture[:] = np.where((state == _EMPTY)[..., None], values, texture)
