"""Which object is seen at a pixel, as the renderers blend it: without a picture, in milliseconds.

The object at a pixel is the one whose splats have the largest sum of blending weights there (`raster.object_map` says
the same for whole pictures). Splats lie in blocks of near and equally large ones; a block whose bounding sphere cannot
reach the pixel is passed over, and what is left gets its exact ellipse. NumPy only, so that Blender's own Python can
import it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .blending import ALPHA_MAX, ALPHA_MIN, BLUR, MAX_EXTENT, MIN_QUAT_NORM2, NEAR, STOP, TAN_MARGIN

BLOCK = 16
"""Splats in a block."""

_BLUR_REACH = math.sqrt(2.0 * math.log(1.0 / ALPHA_MIN) * BLUR)
"""How far, in pixels, the blur carries a splat beyond its own extent at most."""

_GRID = 16
_PROBES = 8
"""Pixels that a rectangle is looked at in: so many across and down, and so many splats of an object."""

Rectangle = tuple[float, float, float, float]
"""Left, top, right, bottom in pixels."""


class Cloud:
    """The splats of one object in its own coordinates, arranged for picking.

    means (N, 3), quats (N, 4) wxyz of any length, scales (N, 3) linear, opacities (N,) in 0 .. 1; those that no
    renderer draws are left out.
    """

    def __init__(self, means: NDArray, quats: NDArray, scales: NDArray, opacities: NDArray) -> None:
        opacities = np.asarray(opacities, np.float64)
        quats = np.asarray(quats, np.float64)
        norms2 = np.einsum("ij,ij->i", quats, quats)
        kept = (opacities > ALPHA_MIN) & np.isfinite(opacities) & (norms2 > MIN_QUAT_NORM2)
        kept &= np.isfinite(means).all(1) & np.isfinite(scales).all(1) & np.isfinite(norms2)
        means, scales, opacities = np.asarray(means, np.float64)[kept], np.asarray(scales)[kept], opacities[kept]
        axes = rotations(quats[kept] / np.sqrt(norms2[kept])[:, None]) * scales[:, None, :]
        extents = np.sqrt(2.0 * np.log(opacities / ALPHA_MIN)) * np.abs(scales).max(1, initial=0.0)
        order = _neighbours(means, extents)
        self.count = len(order)
        if self.count:
            # The last block is filled up with its last splat, which `members` leaves out again.
            order = np.concatenate([order, np.repeat(order[-1:], -len(order) % BLOCK)])
        self.means = means[order]
        self.axes = axes[order].astype(np.float32)
        self.opacities = opacities[order].astype(np.float32)
        self.reaches = extents[order]
        blocks = self.means.reshape(-1, BLOCK, 3)
        self.centres = 0.5 * (blocks.min(1) + blocks.max(1))
        self.radii = np.linalg.norm(blocks - self.centres[:, None], axis=2).max(1)
        self.extents = self.reaches.reshape(-1, BLOCK).max(1)
        # One ball around all.
        self.centre = (
            0.5 * (means.min(0, initial=np.inf) + means.max(0, initial=-np.inf)) if self.count else np.zeros(3)
        )
        self.radius = float(np.linalg.norm(means - self.centre, axis=1).max(initial=0.0))
        self.extent = float(extents.max(initial=0.0))

    def members(self, blocks: NDArray) -> NDArray[np.int64]:
        """Indices of the splats in the blocks with these indices."""
        found = (blocks[:, None] * BLOCK + np.arange(BLOCK)).reshape(-1)
        return found[found < self.count]


@dataclass(frozen=True)
class Placed:
    """An object in the world: its ID, its splats, and the affine map (4, 4) from their coordinates to the world's."""

    object_id: int
    cloud: Cloud
    matrix: NDArray
    hidden: bool = False


@dataclass(frozen=True)
class View:
    """What is looked through: viewmat (4, 4) world to camera with OpenCV axes (x right, y down, z ahead); a point's
    pixel is (fx x + cx, fy y + cy), with x and y divided by z unless `orthographic`, counted from the upper left, the
    first pixel's centre at (0.5, 0.5). Splats nearer than `near` are not seen."""

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
        """From a view matrix and a projection (4, 4) with OpenGL's axes and clip space, as Blender's viewports have."""
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
        """(2, 2): least and greatest x / z and y / z that a splat's shape is projected with."""
        edge_x, edge_y = TAN_MARGIN * 0.5 * self.width, TAN_MARGIN * 0.5 * self.height
        return np.array(
            [
                [(-self.cx - edge_x) / self.fx, (self.width - self.cx + edge_x) / self.fx],
                [(-self.cy - edge_y) / self.fy, (self.height - self.cy + edge_y) / self.fy],
            ]
        )

    def pixels(self, points: NDArray) -> NDArray[np.float64]:
        """(N, 3) camera space -> (N, 2) pixels."""
        plane = points[:, :2] if self.orthographic else points[:, :2] / points[:, 2:]
        return plane * (self.fx, self.fy) + (self.cx, self.cy)


class Seen(NamedTuple):
    """The object at a pixel: its ID, the sum of its splats' weights (0 .. 1), and their mean depth."""

    object_id: int
    weight: float
    depth: float


class _Footprints(NamedTuple):
    """Ellipses in a picture, the nearest first; half: (n, 2) how far each reaches; owner: place among `ids`."""

    ids: NDArray
    owner: NDArray
    centre: NDArray
    half: NDArray
    slope: NDArray
    across2: NDArray
    down2: NDArray
    opacity: NDArray
    depth: NDArray


def pick(objects: Sequence[Placed], view: View, x: float, y: float) -> Seen | None:
    """The object at the place (x, y) in pixels, or None where no splat is drawn. A pixel's centre is at + 0.5."""
    return _seen(_footprints(objects, view, (x, y, x, y)), x, y)


def ids_in(objects: Sequence[Placed], view: View, rectangle: Rectangle) -> set[int]:
    """IDs of the objects that are seen in a rectangle, looked at in a grid of its pixels and where splats have their
    centres."""
    left, top, right, bottom = rectangle
    left, right = max(left, 0.0), min(right, float(view.width))
    top, bottom = max(top, 0.0), min(bottom, float(view.height))
    if left >= right or top >= bottom:
        return set()
    splats = _footprints(objects, view, (left, top, right, bottom))
    found: set[int] = set()
    for y in _spread(top, bottom):
        row = _taken(splats, np.abs(splats.centre[:, 1] - y) <= splats.half[:, 1])
        for x in _spread(left, right):
            seen = _seen(row, x, y)
            if seen is not None:
                found.add(seen.object_id)
    inside = ((splats.centre >= (left, top)) & (splats.centre <= (right, bottom))).all(1)
    for place, object_id in enumerate(splats.ids.tolist()):
        if object_id in found:
            continue
        own = np.flatnonzero(inside & (splats.owner == place))
        # The most opaque ones, since what they show is seen best.
        for index in own[np.argsort(-splats.opacity[own], kind="stable")[:_PROBES]]:
            seen = _seen(splats, *np.floor(splats.centre[index]) + 0.5)
            if seen is not None and seen.object_id == object_id:
                found.add(object_id)
                break
    return found


def rotations(quats: NDArray) -> NDArray[np.float64]:
    """(N, 4) wxyz of length 1 -> (N, 3, 3)."""
    w, x, y, z = quats.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows, np.float64), 2, 0)


def _spread(first: float, last: float) -> NDArray[np.float64]:
    """Centres of pixels between two edges, evenly."""
    count = max(1, min(_GRID, int(last - first)))
    return np.floor(first + (np.arange(count) + 0.5) * (last - first) / count) + 0.5


def _neighbours(means: NDArray, extents: NDArray) -> NDArray[np.int64]:
    """An order in which splats of the same octave of size that are near each other follow each other."""
    if len(means) == 0:
        return np.zeros(0, np.int64)
    octave = np.floor(np.log2(np.maximum(extents, 1e-30))).astype(np.int64)
    octave -= octave.min()
    low = means.min(0)
    steps = ((means - low) * (1023.0 / max(float((means.max(0) - low).max()), 1e-30))).astype(np.int64)
    # The bits of the three numbers take turns (Morton's curve).
    for shift, mask in ((16, 0x30000FF), (8, 0x300F00F), (4, 0x30C30C3), (2, 0x9249249)):
        steps = (steps | (steps << shift)) & mask
    return np.argsort((octave << 30) | (steps[:, 0] << 2) | (steps[:, 1] << 1) | steps[:, 2], kind="stable")


def _may_reach(view: View, rectangle: Rectangle, centres: NDArray, radii: NDArray, extents: NDArray) -> NDArray:
    """Which balls (n,) of splats may reach into the rectangle: centres (n, 3) in camera space, radii (n,) around the
    splats' centres, extents (n,) of the largest splat. True for some that do not."""
    focal = max(abs(view.fx), abs(view.fy))
    nearest = centres[:, 2] - radii
    with np.errstate(all="ignore"):
        at = view.pixels(centres)
        if view.orthographic:
            reach = focal * (radii + extents)
        else:
            slope = np.linalg.norm(centres[:, :2] / centres[:, 2:], axis=1)
            beside = radii * np.sqrt(1.0 + slope**2) / nearest
            limits = view.slope_limits()
            # Slopes are moved into the limits; where those hold 0, none grows by it.
            least = np.linalg.norm(np.maximum(np.maximum(limits[:, 0], -limits[:, 1]), 0.0))
            steepest = np.maximum(slope + beside, least)
            reach = focal * (beside + extents * np.sqrt(1.0 + steepest**2) / nearest)
        reach += _BLUR_REACH + 1e-3 * (reach + 1.0)
        left, top, right, bottom = rectangle
        away = np.maximum(np.maximum((left, top) - at, at - (right, bottom)), 0.0)
        near_enough = np.einsum("ij,ij->i", away, away) <= reach**2
    if not view.orthographic:
        near_enough |= nearest <= view.near  # Such a ball may be anywhere in the picture.
    return near_enough & (centres[:, 2] + radii > view.near)


def _footprints(objects: Sequence[Placed], view: View, rectangle: Rectangle) -> _Footprints:
    """The ellipses of all splats that may reach into the rectangle."""
    shown = [thing for thing in objects if not thing.hidden and thing.cloud.count]
    ids = np.array(sorted({thing.object_id for thing in shown}), np.int64)
    parts = []
    if shown:
        to_camera = np.asarray(view.viewmat, np.float64) @ np.array([thing.matrix for thing in shown], np.float64)
        stretch = np.linalg.norm(to_camera[:, :3, :3], 2, (1, 2))
        centres = np.einsum("nij,nj->ni", to_camera[:, :3, :3], np.array([thing.cloud.centre for thing in shown]))
        radii = stretch * [thing.cloud.radius for thing in shown]
        extents = stretch * [thing.cloud.extent for thing in shown]
        reaching = _may_reach(view, rectangle, centres + to_camera[:, :3, 3], radii, extents)
        for index in np.flatnonzero(reaching):
            owner = int(np.searchsorted(ids, shown[index].object_id))
            columns = _projected(shown[index].cloud, to_camera[index], float(stretch[index]), view, rectangle)
            if len(columns[0]):
                parts.append((np.full(len(columns[0]), owner), *columns))
    if not parts:
        none, pairs = np.zeros(0), np.zeros((0, 2))
        return _Footprints(ids, np.zeros(0, np.int64), pairs, pairs, none, none, none, none, none)
    together = _Footprints(ids, *(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    return _taken(together, np.argsort(together.depth, kind="stable"))


def _projected(
    cloud: Cloud, to_camera: NDArray, stretch: float, view: View, rectangle: Rectangle
) -> tuple[NDArray, ...]:
    """The ellipses of one object: the columns of `_Footprints` after `owner`. stretch: how much longer to_camera (4, 4)
    makes anything at most."""
    turn, move = to_camera[:3, :3].T, to_camera[:3, 3]
    blocks = _may_reach(view, rectangle, cloud.centres @ turn + move, stretch * cloud.radii, stretch * cloud.extents)
    members = cloud.members(np.flatnonzero(blocks))
    places = cloud.means[members] @ turn + move
    none = np.zeros(len(members))
    kept = np.flatnonzero(_may_reach(view, rectangle, places, none, stretch * cloud.reaches[members]))
    members, places = members[kept], places[kept]
    axes = to_camera[:3, :3] @ cloud.axes[members].astype(np.float64)
    if view.orthographic:
        first, second = view.fx * axes[:, 0], view.fy * axes[:, 1]
    else:
        limits = view.slope_limits()
        z = places[:, 2:]
        slopes = np.clip(places[:, :2] / z, limits[:, 0], limits[:, 1])
        first = view.fx / z * (axes[:, 0] - slopes[:, :1] * axes[:, 2])
        second = view.fy / z * (axes[:, 1] - slopes[:, 1:] * axes[:, 2])
    a, b, c = (np.einsum("ij,ij->i", *pair) for pair in ((first, first), (first, second), (second, second)))
    area = np.cross(first, second)
    across2 = (np.einsum("ij,ij->i", area, area) + BLUR * (a + c + BLUR)) / (c + BLUR)
    opacity = cloud.opacities[members].astype(np.float64)
    reach2 = 2.0 * np.log(opacity / ALPHA_MIN)
    half = np.sqrt(reach2[:, None] * np.stack([a + BLUR, c + BLUR], 1))
    centre = view.pixels(places)
    left, top, right, bottom = rectangle
    kept = ((centre + half >= (left, top)) & (centre - half <= (right, bottom))).all(1) & (half.max(1) < MAX_EXTENT)
    columns = (centre, half, b / (c + BLUR), across2, c + BLUR, opacity, places[:, 2])
    return tuple(column[kept] for column in columns)


def _taken(splats: _Footprints, which: NDArray) -> _Footprints:
    return _Footprints(splats.ids, *(column[which] for column in splats[1:]))


def _seen(splats: _Footprints, x: float, y: float) -> Seen | None:
    """The object at a place among the splats around it."""
    off = (x, y) - splats.centre
    near = np.flatnonzero((np.abs(off) <= splats.half).all(1))
    off = off[near]
    d = off[:, 0] - splats.slope[near] * off[:, 1]
    power = 0.5 * (d * d / splats.across2[near] + off[:, 1] ** 2 / splats.down2[near])
    alpha = splats.opacity[near] * np.exp(-power)
    drawn = alpha >= ALPHA_MIN
    near, alpha = near[drawn], np.minimum(alpha[drawn], ALPHA_MAX)
    if len(near) == 0:
        return None
    light = np.concatenate([[1.0], np.cumprod(1.0 - alpha)[:-1]])
    weight = np.where(light >= STOP, alpha * light, 0.0)
    sums = np.bincount(splats.owner[near], weight, len(splats.ids))
    best = int(np.argmax(sums))
    mine = splats.owner[near] == best
    depth = float((weight[mine] * splats.depth[near[mine]]).sum() / sums[best])
    return Seen(int(splats.ids[best]), float(sums[best]), depth)
