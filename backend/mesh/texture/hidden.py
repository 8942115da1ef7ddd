"""Texture of flat parts of a surface that no photo shows, such as a table under the things that stand on it.

The part is seen along its normal, together with its surroundings on the same plane, and is completed with patches of
these. Shading, such as the shadows at its edge, is continued smoothly instead.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np
from scipy.ndimage import (
    binary_closing,
    binary_dilation,
    distance_transform_edt,
    gaussian_filter,
    label,
    map_coordinates,
)
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from .atlas import Texels, fill, interpolate
from .completion import complete

_MOST, _SMALLEST = 100, 12
"""Largest number of parts, the largest first, and the side in texels of the smallest one."""

_FLAT, _ALIGNED, _OFF = 0.8, 0.7, 0.15
"""Smallest length of the mean normal of a part, smallest cosine between normals around it and its own, and largest
distance from its plane, relative to its width."""

_AROUND, _CELLS = 1.0, 512
"""Width of the surroundings on each side, relative to the part, and largest number of cells across all."""

_KNOWN, _ENCLOSED, _BESIDE = 0.3, 0.5, 4
"""Smallest fraction of the cells that photos show, of all and of those beside the part, up to this many cells away."""

_RIM = 2
"""Width in cells of the edge of what photos show that is replaced, too, since it is mixed with what hides the part."""

_SHADING, _LEAST_SHADING = 0.15, 4.0
"""Width of what counts as shading, relative to the square root of the part's cells, and smallest one in cells."""

_DARKEST = 0.015
"""Smallest color whose logarithm is used; shading is a factor."""


class Textured(NamedTuple):
    """A surface and its texels.

    Attributes:
        vertices: (V, 3) float64.
        faces: (F, 3) int32.
        seen: (F,) fraction of each face's texels that photos show; 1 for a face without texels.
        texels: iterates over all texels, some rows at a time.
        size: number of texels.
    """

    vertices: np.ndarray
    faces: np.ndarray
    seen: np.ndarray
    texels: Callable[[], Iterable[Texels]]
    size: int


class _Part:
    """A flat part of a surface with its surroundings, on a grid of square cells in its plane.

    Attributes:
        on_plane: (F,) bool, faces of the part and of its surroundings.
        color: (rows, columns, 3) float32, sums of the texels that photos show, from 0 to 1.
        known, hidden, own: (rows, columns) bool; cells with such texels, with others, and with others of the part.
    """

    def __init__(self, surface: Textured, faces: np.ndarray, normals: np.ndarray, normal: np.ndarray, texel: float):
        corners = surface.vertices[surface.faces]
        self._middle = corners[faces].mean((0, 1))
        self._axes = np.linalg.svd(normal[None])[2][1:]
        flat = (corners - self._middle) @ self._axes.T
        low, high = flat[faces].min((0, 1)), flat[faces].max((0, 1))
        width = float((high - low).max())
        self._low, high = low - _AROUND * width, high + _AROUND * width
        self._cell = max(texel, float((high - self._low).max()) / _CELLS)
        near = (flat.min(1) < high).all(1) & (flat.max(1) > self._low).all(1)
        heights = (corners.mean(1) - self._middle) @ normal
        self.on_plane = near & (normals @ normal > _ALIGNED) & (np.abs(heights) < _OFF * width)
        self._is_own = np.zeros(len(surface.faces), bool)
        self._is_own[faces] = True
        shape = tuple(np.ceil((high - self._low) / self._cell).astype(int) + 1)
        self.color, self._count = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32)
        self.hidden, self.own = np.zeros(shape, bool), np.zeros(shape, bool)

    def places(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the places (n, 2) in cells of positions (n, 3), and which are on the grid."""
        places = ((positions - self._middle) @ self._axes.T - self._low) / self._cell
        return places, ((places >= 0) & (places < self._count.shape)).all(1)

    def add(self, positions: np.ndarray, face: np.ndarray, color: np.ndarray, seen: np.ndarray) -> None:
        """Add texels on the plane: positions (n, 3), face and color (n, 3) from 0 to 1, and which photos show."""
        places, inside = self.places(positions)
        cells = places[inside].astype(np.int64)
        seen, color, face = seen[inside], color[inside], face[inside]
        flat, size = np.ravel_multi_index(tuple(cells.T), self._count.shape), self._count.size
        self._count += np.bincount(flat[seen], minlength=size).reshape(self._count.shape)
        for c in range(3):
            self.color[..., c] += np.bincount(flat[seen], color[seen, c], size).reshape(self._count.shape)
        self.hidden.ravel()[flat[~seen]] = True
        self.own.ravel()[flat[~seen & self._is_own[face]]] = True

    def complete(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the completed colors (rows, columns, 3) and where they replace others (rows, columns) bool, if any."""
        known = self._count > 0
        color = self.color / np.maximum(self._count, 1)[..., None]
        around = np.pad(known, _BESIDE), np.pad(self.hidden & ~known, _BESIDE)
        # Cells between texels, which are larger than cells where the surface is distorted.
        hidden = binary_closing(around[1], iterations=2) & ~around[0]
        gaps = binary_closing(around[0], iterations=2) & ~around[0] & ~hidden
        inner = slice(_BESIDE, -_BESIDE)
        hidden, gaps = hidden[inner, inner], gaps[inner, inner]
        nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
        color[gaps] = color[tuple(nearest)][gaps]
        known |= gaps
        connected, _ = label(hidden, np.ones((3, 3)))
        wanted = hidden & np.isin(connected, np.setdiff1d(connected[self.own & hidden], [0]))
        beside = binary_dilation(wanted, iterations=_BESIDE) & ~wanted
        if not beside.any() or known.mean() < _KNOWN or known[beside].mean() < _ENCLOSED:
            return None
        wanted = binary_dilation(wanted, iterations=_RIM)
        known &= ~wanted
        shades = np.log(np.maximum(color, _DARKEST))
        width = max(_LEAST_SHADING, _SHADING * float(np.sqrt(wanted.sum())))
        shading = _smooth(shades, known, width)
        detail = complete(np.where(known[..., None], shades - shading, 0.0), known, wanted)
        if detail is None:
            return None
        color[wanted] = np.exp(detail + shading)[wanted]
        return color.clip(0, 1), wanted


def complete_hidden_parts(
    texture: np.ndarray, seen: np.ndarray, surface: Textured, progress: Callable[[float], object] = lambda _: None
) -> None:
    """Replace the texture of flat parts that no photo shows by what fits to their surroundings, in place.

    Args:
        texture: (size, size, 3) uint8.
        seen: (size, size) bool, texels that photos show.
        surface: the surface.
        progress: called with the fraction that is done.
    """
    parts = _find_parts(surface)
    if not parts:
        return
    flat, is_seen = texture.reshape(-1, 3), seen.ravel()
    for part, texels, positions in _on_planes(parts, surface):
        part.add(positions, texels.face, flat[texels.indices] / 255, is_seen[texels.indices])
    completed = {}
    for number, part in enumerate(parts):
        progress(number / len(parts))
        found = part.complete()
        if found is not None:
            completed[part] = found
    for part, texels, positions in _on_planes(list(completed), surface):
        color, replaced = completed[part]
        places, inside = part.places(positions)
        inside[inside] = replaced[tuple(places[inside].astype(np.int64).T)]
        here = (places[inside] - 0.5).T
        for c in range(3):
            shown = map_coordinates(color[..., c], here, order=1, mode="nearest")
            flat[texels.indices[inside], c] = np.rint(255 * shown)


def _find_parts(surface: Textured) -> list[_Part]:
    """Find the flat parts of which photos show less than half."""
    vertices, faces = surface.vertices, surface.faces
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    normals = np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(area, 1e-30)[:, None]
    area = area / 2
    texel = float(np.sqrt(area.sum() / max(surface.size, 1)))
    hidden = np.flatnonzero(surface.seen < 0.5)
    if not len(hidden) or not texel > 0:
        return []
    corners = (np.repeat(np.arange(len(hidden)), 3), faces[hidden].ravel())
    touching = coo_matrix((np.ones(3 * len(hidden)), corners), (len(hidden), len(vertices))).tocsr()
    count, part = connected_components(touching @ touching.T, directed=False)
    sizes = np.bincount(part, area[hidden], count)
    found = []
    for number in np.argsort(-sizes)[:_MOST]:
        own = hidden[part == number]
        total = area[own] @ normals[own]
        length = float(np.linalg.norm(total))
        if sizes[number] >= (_SMALLEST * texel) ** 2 and length >= _FLAT * sizes[number]:
            found.append(_Part(surface, own, normals, total / length, texel))
    return found


def _on_planes(parts: list[_Part], surface: Textured) -> Iterator[tuple[_Part, Texels, np.ndarray]]:
    """Yield the texels of parts and of their surroundings, with their positions (n, 3) float32, some rows at a time."""
    for texels in surface.texels() if parts else ():
        for part in parts:
            near = part.on_plane[texels.face]
            if near.any():
                chosen = Texels(*(values[near] for values in texels))
                positions = np.empty((len(chosen.face), 3), np.float32)
                interpolate(surface.vertices, surface.faces, chosen.face, chosen.weights, positions)
                yield part, chosen, positions


def _smooth(values: np.ndarray, known: np.ndarray, width: float) -> np.ndarray:
    """Smooth the known values (n, m, 3) with a Gaussian of this width in cells, and continue them smoothly."""
    weight = np.maximum(gaussian_filter(known.astype(np.float64), width), 1e-9)
    smooth = np.stack(
        [gaussian_filter(np.where(known, values[..., c], 0.0), width) / weight for c in range(3)], 2, dtype=np.float32
    )
    fill(smooth, known)
    return smooth.astype(np.float64)
