"""Picking: which object is visible at a pixel, as the renderers blend it, in milliseconds and without an image.

The object at a pixel is the one whose splats have the largest sum of blending weights there, as in
`backend.raster.object_map` for whole images. Splats are grouped in blocks of nearby splats of similar size; a block
whose bounding sphere cannot reach the pixel is skipped, and the exact ellipses of the remaining splats are evaluated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..class_table import ClassTable
from .blending import (
    ALPHA_MAX,
    ALPHA_MIN,
    EPS_2D,
    MAX_EXTENT,
    MIN_QUAT_NORM2,
    NEAR,
    TAN_MARGIN,
    TRANSMITTANCE_THRESHOLD,
    USUAL_EPS_2D,
)

BLOCK = 16
"""Splats in a block."""

_BLUR_REACH = math.sqrt(2.0 * math.log(1.0 / ALPHA_MIN) * USUAL_EPS_2D)
"""Largest distance in pixels by which the low-pass filter extends a splat."""

_GRID = 16
_PROBES = 8
"""Pixels tested in a rectangle: a grid of _GRID x _GRID, and the centers of _PROBES splats per object."""

Rectangle = tuple[float, float, float, float]
"""Left, top, right, bottom in pixels."""


class Cloud:
    """The splats of one object in its own coordinates, arranged for picking.

    Args:
        means: centers (N, 3).
        quats: rotations (N, 4) wxyz of any length.
        scales: standard deviations (N, 3), linear.
        opacities: (N,) in 0 .. 1. Splats that no renderer draws are left out.
        blur: variance in square pixels of the low-pass filter with which they are drawn, at most USUAL_EPS_2D.
    """

    def __init__(
        self, means: NDArray, quats: NDArray, scales: NDArray, opacities: NDArray, blur: float = EPS_2D
    ) -> None:
        self.blur = blur
        opacities = np.asarray(opacities, np.float64)
        quats = np.asarray(quats, np.float64)
        norms2 = np.einsum("ij,ij->i", quats, quats)
        kept = (opacities > ALPHA_MIN) & np.isfinite(opacities) & (norms2 > MIN_QUAT_NORM2)
        kept &= np.isfinite(means).all(1) & np.isfinite(scales).all(1) & np.isfinite(norms2)
        means, scales, opacities = np.asarray(means, np.float64)[kept], np.asarray(scales)[kept], opacities[kept]
        axes = rotations(quats[kept] / np.sqrt(norms2[kept])[:, None]) * scales[:, None, :]
        extents = np.sqrt(2.0 * np.log(opacities / ALPHA_MIN)) * np.abs(scales).max(1, initial=0.0)
        order = _neighbors(means, extents)
        self.count = len(order)
        if self.count:
            # The last block is padded with copies of its last splat, which `splats_in_blocks` leaves out.
            order = np.concatenate([order, np.repeat(order[-1:], -len(order) % BLOCK)])
        self.means = means[order]
        self.axes = axes[order].astype(np.float32)
        self.opacities = opacities[order].astype(np.float32)
        self.reaches = extents[order]
        blocks = self.means.reshape(-1, BLOCK, 3)
        self.centers = 0.5 * (blocks.min(1) + blocks.max(1))
        self.radii = np.linalg.norm(blocks - self.centers[:, None], axis=2).max(1)
        self.extents = self.reaches.reshape(-1, BLOCK).max(1)
        # A bounding sphere of all centers.
        self.center = (
            0.5 * (means.min(0, initial=np.inf) + means.max(0, initial=-np.inf)) if self.count else np.zeros(3)
        )
        self.radius = float(np.linalg.norm(means - self.center, axis=1).max(initial=0.0))
        self.extent = float(extents.max(initial=0.0))

    def splats_in_blocks(self, blocks: NDArray) -> NDArray[np.int64]:
        """Indices of the splats in the blocks with these indices."""
        found = (blocks[:, None] * BLOCK + np.arange(BLOCK)).reshape(-1)
        return found[found < self.count]


@dataclass(frozen=True)
class PickObject:
    """An object in the world: its ID, its splats, and the affine map (4, 4) from their coordinates to the world's."""

    object_id: int
    cloud: Cloud
    matrix: NDArray
    hidden: bool = False


@dataclass(frozen=True)
class View:
    """A camera or viewport.

    viewmat (4, 4): world to camera, OpenCV axes (x right, y down, z forward). A point's pixel is (fx x + cx,
    fy y + cy), with x and y divided by z unless `orthographic`, from the upper left; the center of the first pixel is
    (0.5, 0.5). near: splats nearer than this are not visible.
    """

    viewmat: NDArray
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    near: float = NEAR
    orthographic: bool = False

    @classmethod
    def of_matrices(cls, view: NDArray, projection: NDArray, width: int, height: int) -> View:
        """Make the view of an OpenGL camera, such as one of Blender's viewports.

        Args:
            view: world to camera (4, 4), OpenGL axes.
            projection: camera to clip space (4, 4).
            width, height: size of the viewport in pixels.

        Returns:
            The view.
        """
        projection = np.asarray(projection, np.float64)
        viewmat = np.diag([1.0, -1.0, -1.0, 1.0]) @ np.asarray(view, np.float64)
        orthographic = projection[3, 3] != 0.0
        shift_x, shift_y = projection[:2, 3] if orthographic else -projection[:2, 2]
        if orthographic:
            near = (1.0 + projection[2, 3]) / projection[2, 2]
        else:
            near = projection[2, 3] / (projection[2, 2] - 1.0)
        return cls(
            viewmat=viewmat,
            fx=0.5 * width * projection[0, 0],
            fy=0.5 * height * projection[1, 1],
            cx=0.5 * width * (1.0 + shift_x),
            cy=0.5 * height * (1.0 - shift_y),
            width=width,
            height=height,
            near=near,
            orthographic=bool(orthographic),
        )

    def slope_limits(self) -> NDArray[np.float64]:
        """Limits (2, 2) of x / z and y / z in the projection of a splat's shape: rows x and y, columns min and max."""
        edge_x, edge_y = TAN_MARGIN * 0.5 * self.width, TAN_MARGIN * 0.5 * self.height
        return np.array(
            [
                [(-self.cx - edge_x) / self.fx, (self.width - self.cx + edge_x) / self.fx],
                [(-self.cy - edge_y) / self.fy, (self.height - self.cy + edge_y) / self.fy],
            ]
        )

    def pixels(self, points: NDArray) -> NDArray[np.float64]:
        """Project points (N, 3) in camera space to pixels (N, 2)."""
        plane = points[:, :2] if self.orthographic else points[:, :2] / points[:, 2:]
        return plane * (self.fx, self.fy) + (self.cx, self.cy)


class Hit(NamedTuple):
    """The object at a pixel: its ID, its probability (the sum of its splats' blending weights), and its mean depth."""

    object_id: int
    probability: float
    depth: float


class _Footprints(NamedTuple):
    """Ellipses in the image, nearest first; half (n, 2): their half extents; owner: index into `ids`."""

    ids: NDArray
    owner: NDArray
    center: NDArray
    half: NDArray
    slope: NDArray
    across2: NDArray
    down2: NDArray
    opacity: NDArray
    depth: NDArray


def pick(objects: Sequence[PickObject], view: View, x: float, y: float) -> Hit | None:
    """Find the object at a pixel.

    Args:
        objects: the objects; hidden ones are ignored.
        view: the camera or viewport.
        x, y: position in pixels; pixel centers are at + 0.5.

    Returns:
        The most probable object, or None where no splat is drawn.
    """
    return _hit_at(_footprints(objects, view, (x, y, x, y)), x, y)


def ids_in(objects: Sequence[PickObject], view: View, rectangle: Rectangle) -> set[int]:
    """Find the objects in a rectangle, by testing a grid of its pixels and the centers of splats.

    Args:
        objects: the objects; hidden ones are ignored.
        view: the camera or viewport.
        rectangle: left, top, right, bottom in pixels.

    Returns:
        The IDs of the objects that are visible in it.
    """
    left, top, right, bottom = rectangle
    left, right = max(left, 0.0), min(right, float(view.width))
    top, bottom = max(top, 0.0), min(bottom, float(view.height))
    if left >= right or top >= bottom:
        return set()
    splats = _footprints(objects, view, (left, top, right, bottom))
    found: set[int] = set()
    for y in _grid_positions(top, bottom):
        row = _select(splats, np.abs(splats.center[:, 1] - y) <= splats.half[:, 1])
        for x in _grid_positions(left, right):
            hit = _hit_at(row, x, y)
            if hit is not None:
                found.add(hit.object_id)
    inside = ((splats.center >= (left, top)) & (splats.center <= (right, bottom))).all(1)
    for owner, object_id in enumerate(splats.ids.tolist()):
        if object_id in found:
            continue
        own = np.flatnonzero(inside & (splats.owner == owner))
        # The most opaque ones, which are the most visible.
        for index in own[np.argsort(-splats.opacity[own], kind="stable")[:_PROBES]]:
            hit = _hit_at(splats, *splats.center[index])
            if hit is not None and hit.object_id == object_id:
                found.add(object_id)
                break
    return found


def rotations(quats: NDArray) -> NDArray[np.float64]:
    """Convert unit quaternions (N, 4) wxyz to rotation matrices (N, 3, 3)."""
    w, x, y, z = quats.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows, np.float64), 2, 0)


def _grid_positions(first: float, last: float) -> NDArray[np.float64]:
    """Return evenly spaced pixel centers between two edges."""
    count = max(1, min(_GRID, int(last - first)))
    return np.floor(first + (np.arange(count) + 0.5) * (last - first) / count) + 0.5


def _neighbors(means: NDArray, extents: NDArray) -> NDArray[np.int64]:
    """Return the order of splats by octave of size, then along a space-filling curve."""
    if len(means) == 0:
        return np.zeros(0, np.int64)
    octave = np.floor(np.log2(np.maximum(extents, 1e-30))).astype(np.int64)
    octave -= octave.min()
    low = means.min(0)
    steps = ((means - low) * (1023.0 / max(float((means.max(0) - low).max()), 1e-30))).astype(np.int64)
    # Interleave the bits of the three coordinates (Morton order).
    for shift, mask in ((16, 0x30000FF), (8, 0x300F00F), (4, 0x30C30C3), (2, 0x9249249)):
        steps = (steps | (steps << shift)) & mask
    return np.argsort((octave << 30) | (steps[:, 0] << 2) | (steps[:, 1] << 1) | steps[:, 2], kind="stable")


def may_reach(view: View, rectangle: Rectangle, centers: NDArray, radii: NDArray, extents: NDArray) -> NDArray:
    """Test conservatively which bounding spheres of splats may reach into the rectangle: (n,) bool.

    centers (n, 3): in camera space; radii (n,): around the splats' centers; extents (n,): of the largest splat.
    """
    focal = max(abs(view.fx), abs(view.fy))
    nearest = centers[:, 2] - radii
    with np.errstate(all="ignore"):
        at = view.pixels(centers)
        if view.orthographic:
            reach = focal * (radii + extents)
        else:
            slope = np.linalg.norm(centers[:, :2] / centers[:, 2:], axis=1)
            beside = radii * np.sqrt(1.0 + slope**2) / nearest
            limits = view.slope_limits()
            # Slopes are clamped to the limits, which does not increase them where the limits include 0.
            least = np.linalg.norm(np.maximum(np.maximum(limits[:, 0], -limits[:, 1]), 0.0))
            steepest = np.maximum(slope + beside, least)
            reach = focal * (beside + extents * np.sqrt(1.0 + steepest**2) / nearest)
        reach += _BLUR_REACH + 1e-3 * (reach + 1.0)
        left, top, right, bottom = rectangle
        away = np.maximum(np.maximum((left, top) - at, at - (right, bottom)), 0.0)
        near_enough = np.einsum("ij,ij->i", away, away) <= reach**2
    if not view.orthographic:
        near_enough |= nearest <= view.near  # Such a sphere may cover any part of the image.
    return near_enough & (centers[:, 2] + radii > view.near)


def _footprints(objects: Sequence[PickObject], view: View, rectangle: Rectangle) -> _Footprints:
    """Project all splats that may reach into the rectangle."""
    shown = [obj for obj in objects if not obj.hidden and obj.cloud.count]
    classes = ClassTable([obj.object_id for obj in shown])
    parts = []
    if shown:
        to_camera = np.asarray(view.viewmat, np.float64) @ np.array([obj.matrix for obj in shown], np.float64)
        stretch = np.linalg.norm(to_camera[:, :3, :3], 2, (1, 2))
        centers = np.einsum("nij,nj->ni", to_camera[:, :3, :3], np.array([obj.cloud.center for obj in shown]))
        radii = stretch * [obj.cloud.radius for obj in shown]
        extents = stretch * [obj.cloud.extent for obj in shown]
        reaching = may_reach(view, rectangle, centers + to_camera[:, :3, 3], radii, extents)
        for index in np.flatnonzero(reaching):
            owner = int(classes.classes_of(shown[index].object_id))
            columns = _project(shown[index].cloud, to_camera[index], float(stretch[index]), view, rectangle)
            if len(columns[0]):
                parts.append((np.full(len(columns[0]), owner), *columns))
    if not parts:
        none, pairs = np.zeros(0), np.zeros((0, 2))
        return _Footprints(classes.ids, np.zeros(0, np.int64), pairs, pairs, none, none, none, none, none)
    together = _Footprints(classes.ids, *(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    return _select(together, np.argsort(together.depth, kind="stable"))


def _project(cloud: Cloud, to_camera: NDArray, stretch: float, view: View, rectangle: Rectangle) -> tuple[NDArray, ...]:
    """Project the splats of one object: the columns of `_Footprints` after `owner`.

    stretch: the largest factor by which to_camera (4, 4) scales a length.
    """
    turn, move = to_camera[:3, :3].T, to_camera[:3, 3]
    blocks = may_reach(view, rectangle, cloud.centers @ turn + move, stretch * cloud.radii, stretch * cloud.extents)
    index = cloud.splats_in_blocks(np.flatnonzero(blocks))
    centers = cloud.means[index] @ turn + move
    none = np.zeros(len(index))
    kept = np.flatnonzero(may_reach(view, rectangle, centers, none, stretch * cloud.reaches[index]))
    index, centers = index[kept], centers[kept]
    axes = to_camera[:3, :3] @ cloud.axes[index].astype(np.float64)
    if view.orthographic:
        first, second = view.fx * axes[:, 0], view.fy * axes[:, 1]
    else:
        limits = view.slope_limits()
        z = centers[:, 2:]
        slopes = np.clip(centers[:, :2] / z, limits[:, 0], limits[:, 1])
        first = view.fx / z * (axes[:, 0] - slopes[:, :1] * axes[:, 2])
        second = view.fy / z * (axes[:, 1] - slopes[:, 1:] * axes[:, 2])
    a, b, c = (np.einsum("ij,ij->i", *pair) for pair in ((first, first), (first, second), (second, second)))
    area = np.cross(first, second)
    across2 = (np.einsum("ij,ij->i", area, area) + cloud.blur * (a + c + cloud.blur)) / (c + cloud.blur)
    a, c = a + cloud.blur, c + cloud.blur
    opacity = cloud.opacities[index].astype(np.float64)
    reach2 = 2.0 * np.log(opacity / ALPHA_MIN)
    half = np.sqrt(reach2[:, None] * np.stack([a, c], 1))
    center = view.pixels(centers)
    left, top, right, bottom = rectangle
    kept = ((center + half >= (left, top)) & (center - half <= (right, bottom))).all(1) & (half.max(1) < MAX_EXTENT)
    columns = (center, half, b / c, across2, c, opacity, centers[:, 2])
    return tuple(column[kept] for column in columns)


def _select(splats: _Footprints, which: NDArray) -> _Footprints:
    return _Footprints(splats.ids, *(column[which] for column in splats[1:]))


def _hit_at(splats: _Footprints, x: float, y: float) -> Hit | None:
    """Return the object at a position among the given splats, or None where none is drawn."""
    off = (x, y) - splats.center
    near = np.flatnonzero((np.abs(off) <= splats.half).all(1))
    off = off[near]
    d = off[:, 0] - splats.slope[near] * off[:, 1]
    power = 0.5 * (d * d / splats.across2[near] + off[:, 1] ** 2 / splats.down2[near])
    alpha = splats.opacity[near] * np.exp(-power)
    drawn = alpha >= ALPHA_MIN
    near, alpha = near[drawn], np.minimum(alpha[drawn], ALPHA_MAX)
    if len(near) == 0:
        return None
    transmittance = np.concatenate([[1.0], np.cumprod(1.0 - alpha)[:-1]])
    weight = np.where(transmittance >= TRANSMITTANCE_THRESHOLD, alpha * transmittance, 0.0)
    sums = np.bincount(splats.owner[near], weight, len(splats.ids))
    best = int(np.argmax(sums))
    mine = splats.owner[near] == best
    depth = float((weight[mine] * splats.depth[near[mine]]).sum() / sums[best])
    return Hit(int(splats.ids[best]), float(sums[best]), depth)
