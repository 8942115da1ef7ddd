"""Fusion of the views of an object into its signed distance field, in blocks around the surface.

In each view, a point in front of the visible surface is outside the object; a point near the visible surface of the
object has a signed distance from it; and a point behind the visible surface, whether of this or another object, is
unknown. A point that is unknown in all views is inside if the observed surface surrounds it (winding number), or if it
is just below that surface.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ...raster import Camera
from ...shared.events import Reporter
from ..surface import NoSurface
from ..views import ObjectView, SceneMap
from .blocks import AROUND, SAMPLES, SIDE, Blocks, distinct
from .holes import Patches
from .integrate import Observation, add, may_add, prepare_observation, visible_depth
from .marching import compact, march, parts
from .skin import Skin
from .winding import Winding

RESOLUTION = 256
"""Largest number of voxels along the object's longest side."""
SMALLEST_PART = 0.03
"""Components of the surface with less than this fraction of the area of the largest one are removed as floaters."""

_VOXEL_PER_PIXEL = 0.7
_REACH_VOXELS, _REACH_PIXELS = 5.0, 3.5
_BACK_VOXELS, _BACK_PIXELS = 3.0, 2.0
_BYTES_PER_BLOCK = 8 * SAMPLES * 4
"""Largest memory of a block: sums, values, flags and the triangles in it."""
_KEPT_BYTES = 1.5e9
"""Memory of views' observations that are kept; the others are made again each time, as with many large photos."""
_MOST_POINTS, _THINNING = 8_000_000, 3
"""Number of observed points that are kept in memory, 32 bytes each, and by what they are divided where it is passed."""
_COARSEST, _FEW = 16, 1000
"""Smallest number of voxels along the longest side, regardless of memory; additional blocks allowed in this case."""
_HARDLY_COARSER = 0.8
"""Fraction of the resolution that the photos allow from which on no warning is needed."""
_FILLING = 8
"""Time to fill the holes of the surface, relative to the time of one view, for the progress bar."""
_SURE = 1.0
"""Weight from which on the distance is determined by the views alone."""
_SEEN = 0.1
"""Smallest weight of a seen sample."""
_SKIN = 1.75
"""Depth in voxels below the surface to which samples count as seen; no cell across the surface extends deeper."""


class SeesObjects(Protocol):
    """The part of the interface of `Views` that `fuse` uses."""

    indices: tuple[int, ...]

    def camera(self, index: int) -> Camera: ...

    def scene_map(self, index: int) -> SceneMap: ...

    def object_view(self, index: int, classes: Sequence[int]) -> ObjectView | None: ...


@dataclass
class Field:
    """A signed distance field in voxels, negative inside.

    values (B, 512) float32 at the samples of `blocks`; seen (B, 512) bool: samples observed in a view. Sample (i, j, k)
    of block c lies at origin + voxel * (8 c + (i, j, k)) in scene units. The zero level lies within the blocks.
    """

    origin: np.ndarray
    voxel: float
    blocks: Blocks
    values: np.ndarray
    seen: np.ndarray


@dataclass
class _Extent:
    """The extent of an object.

    Attributes:
        points: Observed points (n, 3), of many a part.
        low, high: Corners of the bounding box without outliers.
        pixel: Median size of a pixel on the object.
        nearest: Smallest depth of the object in a view.
    """

    points: np.ndarray
    low: np.ndarray
    high: np.ndarray
    pixel: float
    nearest: float


def fuse(
    views: SeesObjects,
    classes: Sequence[int],
    resolution: int = RESOLUTION,
    memory_mb: float = 1500,
    reporter: Reporter | None = None,
    name: str = "the objects",
) -> Field:
    """Fuse the views of objects into one signed distance field.

    The voxel is 0.7 times the size of a pixel on the object, or its longest side / `resolution` if that is larger.

    Args:
        views: The renders of the model.
        classes: The class indices of the objects, which are treated as one object.
        resolution: The largest number of voxels along the longest side.
        memory_mb: Memory limit. If it is too small, voxels are enlarged, with a warning if it is by much.
        reporter: Receives the progress and the warning.
        name: What the warning calls the objects.

    Returns:
        The field around the surface.

    Raises:
        NoSurface: Too little of the objects was observed.
    """
    reporter = reporter or Reporter()
    extent = _extent(views, classes, reporter)
    size = float((extent.high - extent.low).max())
    voxel = max(_VOXEL_PER_PIXEL * extent.pixel, size / resolution)
    max_blocks = max(int(memory_mb * 1e6 / _BYTES_PER_BLOCK), 64)
    requested_voxel = voxel
    while True:
        try:
            field = _Fusion(views, classes, extent, voxel, max_blocks, reporter).run()
            break
        except _TooMany as error:
            voxel *= max(1.1, (error.blocks / max_blocks) ** 0.5)
            if voxel > size / _COARSEST:
                # Allow a few more blocks, whose memory is negligible.
                voxel, max_blocks = max(requested_voxel, size / _COARSEST), error.blocks + _FEW
    if voxel * _HARDLY_COARSER > requested_voxel:
        reporter.warning(f"The mesh of {name} is coarser than the photos allow, to save memory.")
    return field


def _extent(views: SeesObjects, classes: Sequence[int], reporter: Reporter) -> _Extent:
    """Compute the extent of the object from the pixels that show it."""
    points, pixels, nearest, every = [np.zeros((0, 3))], [np.zeros(0)], np.inf, 1
    for done, index in enumerate(views.indices):
        reporter.progress(done, 2 * len(views.indices) + _FILLING)
        view = views.object_view(index, classes)
        if view is None:
            continue
        depth = visible_depth(view)
        v, u = np.nonzero(depth)
        d = depth[v, u].astype(np.float64)
        nearest = min(nearest, d.min(initial=np.inf))
        kept = slice(done % every, None, every)
        v, u, d = v[kept], u[kept], d[kept]
        points.append(_lifted(view.camera, u + 0.5, v + 0.5, d))
        pixels.append(d / view.camera.K[0, 0])
        while sum(map(len, pixels)) > _MOST_POINTS:
            every *= _THINNING
            points, pixels = (
                # Others in each view, in case all pixels of a column are left out.
                [values[i % _THINNING :: _THINNING].copy() for i, values in enumerate(each)]
                for each in (points, pixels)
            )
    found = np.concatenate(points)
    if len(found) < 8:
        raise NoSurface("No view shows enough of it: it is hidden, out of view or too small to be seen.")
    low, high = np.quantile(found, (0.01, 0.99), axis=0)
    return _Extent(found, low, high, float(np.median(np.concatenate(pixels))), float(nearest))


def _lifted(camera: Camera, u: np.ndarray, v: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Unproject the pixels (u, v) to points (n, 3) at `depth`."""
    K = camera.K
    local = np.stack([(u - K[0, 2]) / K[0, 0] * depth, (v - K[1, 2]) / K[1, 1] * depth, depth], 1)
    return (local - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]


class _TooMany(Exception):
    def __init__(self, blocks: int) -> None:
        self.blocks = blocks


class _Fusion:
    def __init__(
        self, views: SeesObjects, classes: Sequence[int], extent: _Extent, voxel: float, max_blocks: int,
        reporter: Reporter,
    ) -> None:  # fmt: skip
        self.views = views
        self.classes = classes
        self.extent = extent
        self.voxel = voxel
        self.max_blocks = max_blocks
        self.reporter = reporter
        self.reach = max(_REACH_VOXELS * voxel, _REACH_PIXELS * extent.pixel)
        self.back = max(_BACK_VOXELS * voxel, _BACK_PIXELS * extent.pixel)
        self.origin = (extent.low + extent.high) / 2
        self.observations: dict[int, Observation] = {}
        self.room = _KEPT_BYTES
        # The object lies within this box; no blocks are added outside it.
        pad = (extent.high - extent.low).max() * 0.5 + 4 * self.reach
        self.box = np.stack([extent.low - pad - self.origin, extent.high + pad - self.origin]) / (SIDE * voxel)
        self.rounds = 0

    def run(self) -> Field:
        blocks = Blocks(self._touched())
        self._check(len(blocks))
        total, weights = self._integrated(blocks.coords)
        winding = self._seen_surface(blocks, total, weights)
        values = self._finished(blocks.coords, total, weights, winding)
        seen = self._seen(total, weights) & ~self._at_border(blocks.coords)
        fresh = np.arange(len(blocks))
        while True:
            coords = self._missing(blocks, values, fresh)
            if not len(coords):
                break
            self._check(len(blocks) + len(coords))
            total, weights = self._integrated(coords)
            fresh = np.arange(len(blocks), len(blocks) + len(coords))
            blocks = blocks.joined(coords)
            values = np.concatenate([values, self._finished(coords, total, weights, winding)])
            seen = np.concatenate([seen, self._seen(total, weights) & ~self._at_border(coords)])
            self.rounds += 1
        return Field(self.origin, self.voxel, blocks, values, seen)

    def _check(self, blocks: int) -> None:
        if blocks > self.max_blocks:
            raise _TooMany(blocks)

    def _touched(self) -> np.ndarray:
        """Find the blocks within reach of an observed point."""
        points = (self.extent.points - self.origin) / self.voxel
        coarse = distinct(np.floor(points).astype(np.int64))
        offset = self.reach / self.voxel
        # At most a block apart, so that none in between is missed.
        steps = np.linspace(-offset, offset, 1 + int(np.ceil(2 * offset / SIDE)))
        found = [
            distinct(np.floor((coarse + 0.5 + step) / SIDE).astype(np.int64))
            for step in itertools.product(steps, repeat=3)
        ]
        return self._in_box(distinct(np.concatenate(found)))

    def _in_box(self, coords: np.ndarray) -> np.ndarray:
        return coords[((coords >= np.floor(self.box[0])) & (coords <= self.box[1])).all(1)]

    def _at_border(self, coords: np.ndarray) -> np.ndarray:
        """Find the samples of blocks that are the outermost ones of the box, (n, 512) bool."""
        found = np.zeros((len(coords), SIDE, SIDE, SIDE), bool)
        for end, layer in zip(np.floor(self.box), (0, SIDE - 1), strict=True):
            for axis in range(3):
                np.moveaxis(found, axis + 1, 1)[coords[:, axis] == end[axis], layer] = True
        return found.reshape(-1, SAMPLES)

    def _observation(self, index: int) -> Observation:
        if index in self.observations:
            return self.observations[index]
        scene = self.views.scene_map(index)
        view = self.views.object_view(index, self.classes)
        margin = 0
        if view is not None:
            margin = int(np.ceil(self.reach * scene.camera.K[0, 0] / max(self.extent.nearest, 1e-9))) + 1
        found = prepare_observation(scene, view, min(margin, 64), 2 * self.reach)
        if found.nbytes <= self.room:
            self.room -= found.nbytes
            self.observations[index] = found
        return found

    def _integrated(self, coords: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        total = np.zeros((len(coords), SAMPLES), np.float32)
        weights = np.zeros((len(coords), SAMPLES), np.float32)
        for done, index in enumerate(self.views.indices):
            # Other views need not be rendered.
            if index in self.observations or may_add(self.views.camera(index), self.origin, self.voxel, coords):
                add(self._observation(index), self.origin, self.voxel, coords, self.reach, self.back, total, weights)
            self._progress(done + 1)
        return total, weights

    def _seen_surface(self, blocks: Blocks, total: np.ndarray, weights: np.ndarray) -> Winding:
        values = _nudged(total / np.maximum(weights, 1e-9) / self.voxel)
        vertices, faces, _ = march(blocks, values, self._seen(total, weights), closed=False)
        vertices, faces = largest_parts(vertices, faces)
        if not len(faces):
            raise NoSurface("The views see too little of it, or do not agree on where it is.")
        self.patches, self.skin = Patches(vertices, faces), Skin(vertices, faces)
        return Winding(
            np.concatenate([vertices, self.patches.points]),
            np.concatenate([faces, self.patches.faces + len(vertices)]),
        )

    def _seen(self, total: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the samples observed in front of the surface or just below it, (B, 512) bool."""
        return (weights >= _SEEN) & (total > -_SKIN * self.voxel * weights)

    def _progress(self, views: float) -> None:
        """Report the number of views integrated in the first round; later rounds have few samples."""
        count = len(self.views.indices)
        self.reporter.progress(2 * count if self.rounds else count + views, 2 * count + _FILLING)

    def _finished(self, coords: np.ndarray, total: np.ndarray, weights: np.ndarray, winding: Winding) -> np.ndarray:
        """Return the distances in voxels; unobserved ones are computed from the winding number, except in the skin.

        What reaches the border of the box ends there.
        """
        values = total / np.maximum(weights, 1e-9) / self.voxel
        unsure = weights < _SURE
        reach = self.reach / self.voxel
        size = (self.extent.high - self.extent.low).mean() / self.voxel
        closing = np.clip((0.5 - winding.at(coords, unsure)) * size, -reach, reach)
        self.patches.thicken(coords, unsure, 0.8 * self.back / self.voxel, closing)
        self.skin.keep(coords, self._seen(total, weights) & (total < 0) & (closing > 0), values, closing)
        share = np.minimum(weights / _SURE, 1)
        values = share * values + (1 - share) * closing
        return _nudged(np.where(self._at_border(coords), np.maximum(values, 0), values))

    def _missing(self, blocks: Blocks, values: np.ndarray, fresh: np.ndarray) -> np.ndarray:
        """Find the missing neighbors (n, 3) of blocks that the surface crosses."""
        inside = (values < 0).reshape(-1, SIDE, SIDE, SIDE)
        near = fresh if not self.rounds else np.unique(
            np.concatenate([fresh, *(blocks.find(blocks.coords[fresh] + step) for step in _FACES)])
        )  # fmt: skip
        near = near[near >= 0]
        flat = inside[near].reshape(len(near), -1)
        crossed = flat.any(1) & ~flat.all(1)
        for step in _FACES:
            beside = blocks.find(blocks.coords[near] + step)
            known = beside >= 0
            axis = int(np.abs(step).argmax())
            mine, theirs = (-1, 0) if step[axis] > 0 else (0, -1)
            differs = inside[near[known]].take(mine, axis + 1) != inside[beside[known]].take(theirs, axis + 1)
            crossed[known] |= differs.any((1, 2))
        around = self._in_box(distinct((blocks.coords[near[crossed]][:, None] + AROUND).reshape(-1, 3)))
        return around[blocks.find(around) < 0]


_FACES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])


def _nudged(values: np.ndarray) -> np.ndarray:
    """Move values away from 0, so that no two vertices coincide."""
    return np.where(values < 0, np.minimum(values, -1e-3), np.maximum(values, 1e-3)).astype(np.float32)


def largest_parts(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Remove the floaters among the connected components of a surface."""
    keep = faces[of_size(vertices, faces)]
    return compact(vertices, keep)


def of_size(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Find the faces of components with at least SMALLEST_PART of the area of the largest one, (F,) bool."""
    count, part = parts(faces, len(vertices))
    if not count:
        return np.zeros(0, bool)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.bincount(part, np.linalg.norm(np.cross(b - a, c - a), axis=1), count)
    return (area >= SMALLEST_PART * area.max())[part]
