"""Filling the hole that a removed or moved object leaves in the ground or a wall, with copies of the surroundings.

The object stands on or against planes; the splats of its neighbors are in these planes or, as in rumpled cloth, near
them. No photo shows the part of such a plane that the object hid. That part is filled with a patch of the visible part
whose detail (grain, joints) best fits the rim of the hole, adjusted to the colors and the relief around the hole. Where
several objects meet under the removed one, such as sheets of paper, each is continued with straight edges.

A hole is filled only where the surface surrounds it, since the object may stand at the edge of the surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, rfft2
from scipy.ndimage import (
    binary_closing,
    binary_dilation,
    binary_fill_holes,
    binary_opening,
    distance_transform_edt,
    gaussian_filter,
    map_coordinates,
)
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ..model.splats import Splats, concatenate
from ..shared.splats.convex_hull import reliable_centers
from ..shared.splats.spherical_harmonics import C0

PLANES = 3
"""Largest number of planes, since an object may stand in a corner."""
NEAR = 0.5
"""Distance from the object within which planes are searched, relative to its size."""
FLAT_WITHIN = (0.02, 0.04, 0.08)
"""Largest distances of a plane's splats from it, relative to the object's size. The larger ones, for surfaces that are
not flat, are tried if the smaller ones leave the hole open."""
PART_OF_IT = 0.5
"""Smallest fraction, in a plane, of another object's splats near the removed one; with less, it only stands on it."""
LOWEST_PERCENT = 3.0
TOUCHES_WITHIN = 0.1
"""Largest height of the object's `LOWEST_PERCENT` percentile above a plane that it touches, relative to its size."""
FEWEST = 60
"""Smallest number of splats in a plane."""
ALIGNED = 0.7
"""Smallest cosine between a plane's normal and the thinnest axis of a splat in it."""
COVERED = 0.3
"""Smallest alpha along a plane's normal where it has no hole; the splats that make it opaque may lie deeper."""
WINDOW = 3.0
"""Width of the surroundings that a patch may come from, relative to the object's footprint."""
CELLS = 128
"""Cells across the window."""
SURROUNDS = 0.2
"""Smallest fraction of the window that a plane covers; with less, it is a side of a small object."""
ENCLOSED = 0.5
"""Smallest fraction of the touched cells that the surface surrounds; with less, the object stands at its edge."""
RIM = 2
"""Cells around the hole that are replaced, too, since they are mixed with the object."""
BAND = 5
"""Cells around the hole by which a patch is chosen."""
SMALLEST_PATCH = 4
RELIEF_WITHIN = 0.03
"""Smallest height of a bump on the surface above or below its surroundings, relative to the object's size."""
SHELL = 0.06
"""Distance from the object's own splats, relative to its size, within which splats that have the surface's IDs and are
above its plane are taken for mislabeled splats of the object."""

_TRIPLES = 600
_SCORED = 3000
_REACH = 3.0
_WIDEST = 16


def fill_hole(
    splats: Splats, removed: Splats, progress: Callable[[float], object] = lambda _: None
) -> tuple[NDArray[np.bool_], Splats]:
    """Fill the holes that a removed object leaves.

    Args:
        splats: The N splats of the scene without the object.
        removed: The splats of the object.
        progress: Called with the fraction that is done.

    Returns:
        (N,) bool: the splats at the rims of the holes that the filling replaces, and the filling splats, which are
        unobserved and have the IDs of the surface that they continue.
    """
    gone, parts = np.zeros(len(splats), bool), [splats.select(slice(0, 0))]
    solid = reliable_centers(removed.means, removed.opacities)
    if len(solid) < FEWEST:
        return gone, parts[0]
    size = float(np.linalg.norm(np.percentile(solid, 95, axis=0) - np.percentile(solid, 5, axis=0)))
    middle = np.median(solid, axis=0)
    around = _Around(splats, solid - middle, middle, size)
    for tries, within in enumerate(FLAT_WITHIN):
        # Labels of a rough surface are rough, too: more of the object's lowest splats may belong to it.
        rough = within / FLAT_WITHIN[0]
        planes = around.planes(within * size)
        for number, (plane, flat) in enumerate(planes, 1):
            progress((tries + number / (len(planes) + 1)) / len(FLAT_WITHIN))
            surface = _Surface(plane, splats.select(flat), around.centered[flat], solid - middle, size, rough)
            replaced, patches = surface.fill_hole(surface.beyond([other for other, _ in planes if other is not plane]))
            gone[flat[replaced]] = True
            if patches:
                gone[around.shell(flat, [each for each, _ in planes], within * size)] = True
            parts += patches
        if len(parts) > 1:
            break
    return gone, concatenate(parts)


class _Around:
    """The splats around a removed object.

    Attributes:
        solid: (m, 3) centers of the object's own splats, relative to its center `middle`.
        centered: (N, 3) centers of all splats, relative to `middle`.
        far: (N,) their distances from the nearest of `solid`, infinite beyond `NEAR`.
        near: indices of the splats in which planes are searched.
        reach: indices of the splats from which planes may be continued.
        thin: (N, 3) thinnest axes of the splats in `reach`, otherwise 0.
    """

    def __init__(self, splats: Splats, solid: NDArray, middle: NDArray, size: float) -> None:
        self.splats, self.solid, self.size = splats, solid, size
        self.centered = splats.means.astype(np.float64) - middle
        self.reach = np.flatnonzero(np.linalg.norm(self.centered, axis=1) < (1.0 + WINDOW) * size)
        self.far = np.full(len(splats), np.inf)
        self.far[self.reach] = cKDTree(solid).query(self.centered[self.reach], distance_upper_bound=NEAR * size)[0]
        self.near = np.flatnonzero(np.isfinite(self.far) & (splats.opacities > 0.3))
        self.thin = np.zeros_like(self.centered)
        self.thin[self.reach] = _thin_axes(splats.select(self.reach))

    def planes(self, within: float) -> list[tuple[_Plane, NDArray[np.int64]]]:
        """Find the planes that the object stands on or at, and the indices of the splats of the surface in each."""
        near = self.near
        found: list[tuple[_Plane, NDArray[np.int64]]] = []
        while len(found) < PLANES:
            before = [plane for plane, _ in found]
            plane = _plane(self.centered[near], self.thin[near], self.solid, self.size, within, before)
            if plane is None:
                break
            flat = np.abs(plane.height(self.centered)) < within
            ids, counts = np.unique(self.splats.object_ids[near[flat[near]]], return_counts=True)
            there = self.splats.object_ids[self.near]
            part = [
                object_id
                for object_id, count in zip(ids.tolist(), counts.tolist())
                if count == counts.max() or count >= max(FEWEST, PART_OF_IT * (there == object_id).sum())
            ]
            found.append((plane, self.reach[flat[self.reach] & np.isin(self.splats.object_ids[self.reach], part)]))
            near = near[~flat[near]]
        return found

    def shell(self, flat: NDArray[np.int64], planes: list[_Plane], within: float) -> NDArray[np.int64]:
        """Find splats above all planes and near the removed object that have the IDs of a plane's splats `flat`."""
        close = np.flatnonzero(self.far < SHELL * self.size)
        standing = np.all([plane.height(self.centered[close]) > within for plane in planes], axis=0)
        return close[standing & np.isin(self.splats.object_ids[close], np.unique(self.splats.object_ids[flat]))]


@dataclass(frozen=True)
class _Plane:
    """A plane through `point` (3,); axes (3, 3): two rows in it, the third its normal towards the object."""

    point: NDArray
    axes: NDArray

    def height(self, points: NDArray) -> NDArray:
        """Return the heights (n,) of points (n, 3) above the plane."""
        return (points - self.point) @ self.axes[2]

    def flat(self, points: NDArray) -> NDArray:
        """Return the coordinates (n, 2) of points (n, 3) in the plane."""
        return (points - self.point) @ self.axes[:2].T


def _thin_axes(splats: Splats) -> NDArray[np.float64]:
    """Return the thinnest axis of each splat, (N, 3)."""
    axes = Rotation.from_quat(splats.quats.astype(np.float64), scalar_first=True).as_matrix()
    return np.take_along_axis(axes, splats.scales.argmin(1)[:, None, None], 2)[:, :, 0]


def _plane(
    points: NDArray, thin: NDArray, solid: NDArray, size: float, within: float, before: list[_Plane]
) -> _Plane | None:
    """Find the plane that touches the object's centers, solid (m, 3), and contains the most of points (n, 3).

    A plane contains points that are within the distance `within` and whose thin axes (n, 3) are along its normal.
    Planes parallel to those in `before`, within `ALIGNED`, are excluded. Returns None if there is no other.
    """
    if len(points) < FEWEST:
        return None
    rng = np.random.default_rng(0)
    corners = points[rng.integers(len(points), size=(_TRIPLES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    usable = lengths > (0.05 * size) ** 2
    normals = normals[usable] / lengths[usable, None]
    found, most = None, FEWEST - 1
    some, some_thin = (values[:: -(-len(points) // _SCORED)] for values in (points, thin))
    solid = solid[:: -(-len(solid) // _SCORED)]
    for normal, corner in zip(normals, corners[usable, 0]):
        heights = (solid - corner) @ normal
        if np.median(heights) < 0:
            normal, heights = -normal, -heights
        lowest = np.percentile(heights, LOWEST_PERCENT)
        if _is_parallel(normal, before) or not -within <= lowest <= TOUCHES_WITHIN * size:
            continue
        count = ((np.abs((some - corner) @ normal) < within) & (np.abs(some_thin @ normal) > ALIGNED)).sum()
        if count > most:
            found, most = (corner, normal), int(count)
    if found is None:
        return None
    corner, normal = found
    inliers = (np.abs((points - corner) @ normal) < within) & (np.abs(thin @ normal) > ALIGNED)
    for _ in range(3):
        point = points[inliers].mean(0)
        axes = np.linalg.svd(points[inliers] - point, full_matrices=False)[2]
        axes *= np.sign(axes[2] @ normal)
        inliers = (np.abs((points - point) @ axes[2]) < within) & (np.abs(thin @ axes[2]) > ALIGNED)
    # What is left of a rough surface may fit to a tilted plane, which turns to that surface then.
    return None if _is_parallel(axes[2], before) else _Plane(point, axes)


def _is_parallel(normal: NDArray, planes: list[_Plane]) -> bool:
    return any(abs(plane.axes[2] @ normal) > ALIGNED for plane in planes)


class _Surface:
    """The splats that lie in a plane, seen along its normal on a grid of square cells around the object.

    Attributes:
        at: (n, 2) centers of the splats in cells.
        appearance: (n, 4) base color, and height above the plane in cells.
        owners: the distinct object IDs of the splats; `owner` (n,) has their indices.
        under, touched: (CELLS, CELLS) bool, the cells that the object hides, and those that it touches.
    """

    def __init__(
        self, plane: _Plane, splats: Splats, centered: NDArray, solid: NDArray, size: float, rough: float
    ) -> None:
        footprint = plane.flat(solid)
        low, high = footprint.min(0), footprint.max(0)
        width = WINDOW * float((high - low).max())
        self.plane, self.cell = plane, width / CELLS
        self.corner = corner = 0.5 * (low + high) - 0.5 * width
        self.at = (plane.flat(centered) - corner) / self.cell
        self.inside = ((self.at >= 0) & (self.at < CELLS)).all(1)
        self.splats = splats
        self.relief = RELIEF_WITHIN * size / self.cell
        height = plane.height(centered) / self.cell
        self.appearance = np.column_stack([0.5 + C0 * splats.sh[:, 0].astype(np.float64), height])
        self.owners, self.owner = np.unique(splats.object_ids, return_inverse=True)
        cells = ((footprint - corner) / self.cell).astype(int)
        self.under = _fill_footprint(cells)
        # No camera has seen the plane where the object touches it, even if splats exist there.
        self.touched = _fill_footprint(cells[plane.height(solid) < rough * TOUCHES_WITHIN * size])

    def _render_top(self) -> tuple[NDArray, NDArray, NDArray]:
        """Return the cells' alpha (CELLS, CELLS), mean appearance (CELLS, CELLS, 4), and the main one of `owners`."""
        rotations = Rotation.from_quat(self.splats.quats.astype(np.float64), scalar_first=True).as_matrix()
        spread = self.plane.axes[:2] @ rotations * (self.splats.scales[:, None, :] / self.cell)
        covariance = spread @ spread.transpose(0, 2, 1) + 0.1 * np.eye(2)
        inverse = np.linalg.inv(covariance)
        radius = np.ceil(_REACH * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).max(1))).clip(1, _WIDEST)
        home = np.floor(self.at).astype(int)
        radius[((home < -_WIDEST) | (home >= CELLS + _WIDEST)).any(1)] = -1
        logs, appearances = np.zeros((CELLS, CELLS)), np.zeros((CELLS, CELLS, 4))
        weights = np.zeros((len(self.owners), CELLS, CELLS))
        for dx in range(-_WIDEST, _WIDEST + 1):
            for dy in range(-_WIDEST, _WIDEST + 1):
                reached = np.flatnonzero(radius >= max(abs(dx), abs(dy)))
                cells = home[reached] + (dx, dy)
                on_grid = ((cells >= 0) & (cells < CELLS)).all(1)
                reached, cells = reached[on_grid], tuple(cells[on_grid].T)
                if len(reached) == 0:
                    continue
                away = np.stack(cells, 1) + 0.5 - self.at[reached]
                power = np.einsum("ni,nij,nj->n", away, inverse[reached], away)
                alpha = np.minimum(self.splats.opacities[reached] * np.exp(-0.5 * power), 0.99)
                np.add.at(logs, cells, np.log1p(-alpha))
                np.add.at(weights, (self.owner[reached], *cells), alpha)
                np.add.at(appearances, cells, alpha[:, None] * self.appearance[reached])
        return 1.0 - np.exp(logs), appearances / np.maximum(weights.sum(0), 1e-9)[..., None], weights.argmax(0)

    def beyond(self, others: list[_Plane]) -> NDArray[np.bool_]:
        """Find the cells (CELLS, CELLS) on the far side of other planes, where this one has no hole to fill."""
        flat = np.stack(np.meshgrid(*2 * [np.arange(CELLS) + 0.5], indexing="ij"), 2) * self.cell + self.corner
        places = flat @ self.plane.axes[:2] + self.plane.point
        found = np.zeros((CELLS, CELLS), bool)
        for other in others:
            found |= other.height(places) < 0.0
        return found

    def fill_hole(self, beyond: NDArray) -> tuple[NDArray[np.int64], list[Splats]]:
        """Return the indices of the replaced splats, and the filling; the cells `beyond` are not in the plane."""
        coarse = np.unique(self.at[self.inside] // (CELLS // 16), axis=0)
        if len(coarse) < SURROUNDS * 16 * 16:
            return np.zeros(0, np.int64), []
        coverage, appearance, owner = self._render_top()
        covered = gaussian_filter(coverage, 1.0) > COVERED
        whole = binary_fill_holes(binary_closing(covered | beyond, iterations=2)) & ~beyond
        hole = whole & (self.touched | (self.under & ~covered))
        enclosed = (whole & self.touched).sum() >= ENCLOSED * (self.touched & ~beyond).sum()
        if not hole.any() or not enclosed or covered.mean() < SURROUNDS:
            return np.zeros(0, np.int64), []
        target = binary_dilation(hole, iterations=RIM) & whole
        good = covered & ~binary_dilation(hole, iterations=RIM + 1)
        bump = np.abs(appearance[..., 3] - _smooth(appearance[..., 3:], good, CELLS / 16)[..., 0]) > self.relief
        good &= ~binary_opening(bump, iterations=1)
        open_still, parts = target.copy(), []
        continued = _continued_owners(owner, good, hole)
        for i in np.unique(owner[good]):
            parts += self._continue_surface(target & (continued == i), good & (owner == i), appearance, open_still)
        parts += self._continue_surface(open_still.copy(), good, appearance, open_still)
        home = np.floor(self.at).astype(int)
        replaced = np.zeros(len(home), bool)
        replaced[self.inside] = (target & ~open_still)[tuple(home[self.inside].T)]
        return np.flatnonzero(replaced), parts

    def _continue_surface(
        self, target: NDArray, good: NDArray, appearance: NDArray, open_still: NDArray
    ) -> list[Splats]:
        """Fill the cells `target` with copies of good ones, and remove those that are filled from `open_still`."""
        if not target.any() or not good.any():
            return []
        shades = _smooth(appearance, good, max(BAND, 0.5 * np.sqrt(target.sum())))
        detail = np.where(good[..., None], appearance - shades, 0.0)[..., :3]
        parts = []
        for part, shift in _patches(target, good, detail):
            copied = self._copy_patch(part, shift, shades)
            if len(copied):
                parts.append(copied)
                open_still &= ~part
        return parts

    def _copy_patch(self, part: NDArray, shift: tuple[int, int], shades: NDArray) -> Splats:
        """Copy the splats at `part` plus `shift` to `part`, with the color and the relief there."""
        target = self.at - shift
        home = np.floor(target).astype(int)
        mine = self.inside & ((home >= 0) & (home < CELLS)).all(1)
        mine[mine] = part[tuple(home[mine].T)]
        copies = self.splats.select(mine)
        there, here = (
            np.column_stack([
                map_coordinates(shades[..., i], (places[mine] - 0.5).T, order=1, mode="nearest") for i in range(4)
            ])
            for places in (target, self.at)
        )  # fmt: skip
        change = there - here
        sh = copies.sh.copy()
        sh[:, 0] += change[:, :3] / C0
        back = self.cell * np.column_stack([np.tile(-np.array(shift, float), (len(copies), 1)), change[:, 3]])
        means = (copies.means + back @ self.plane.axes).astype(copies.means.dtype)
        return replace(copies, means=means, sh=sh, unobserved=np.ones(len(copies), bool))


def _continued_owners(owner: NDArray, good: NDArray, hole: NDArray) -> NDArray[np.int64]:
    """Continue the owners (n, n) of the good cells near the hole into it with straight edges.

    A linear function of the position is fitted to each owner's cells; the largest one decides.
    """
    away = distance_transform_edt(~hole)
    cells = np.argwhere(good & (away < max(BAND, np.sqrt(hole.sum()))))
    if len(cells) == 0:
        return owner
    ids, which = np.unique(owner[tuple(cells.T)], return_inverse=True)
    terms = np.column_stack([cells, np.ones(len(cells))])
    functions = np.linalg.lstsq(terms, np.eye(len(ids))[which], rcond=None)[0]
    places = np.indices(owner.shape).reshape(2, -1)
    best = (functions[:2].T @ places + functions[2][:, None]).argmax(0)
    return ids[best].reshape(owner.shape)


def _smooth(values: NDArray, good: NDArray, width: float) -> NDArray:
    """Smooth values (n, n, k) over the good cells (n, n) with a Gaussian of this width in cells."""
    known = np.maximum(gaussian_filter(good.astype(float), width), 1e-9)
    of_good = np.where(good[..., None], values, 0.0)
    return np.stack([gaussian_filter(of_good[..., i], width) / known for i in range(values.shape[2])], 2)


def _fill_footprint(cells: NDArray) -> NDArray[np.bool_]:
    """Return the cells (CELLS, CELLS) bool of cells (n, 2) with gaps and holes closed."""
    found = np.zeros((CELLS, CELLS), bool)
    found[tuple(cells.clip(0, CELLS - 1).T)] = True
    return binary_fill_holes(binary_closing(found, iterations=6))


def _patches(target: NDArray, good: NDArray, detail: NDArray) -> list[tuple[NDArray, tuple[int, int]]]:
    """Split the cells to fill, target (n, n), into parts, each with the shift to the cells of `good` whose detail best
    fits its rim; cells for which no shift is found are left out."""
    shift = _best_shift(target, good, detail)
    if shift is not None:
        return [(target, shift)]
    rows, columns = (np.flatnonzero(target.any(axis)) for axis in (1, 0))
    if len(rows) == 0 or max(np.ptp(rows), np.ptp(columns)) < SMALLEST_PATCH:
        return []
    first, second = target.copy(), target.copy()
    if np.ptp(rows) >= np.ptp(columns):
        half = int(rows.mean()) + 1
        first[half:], second[:half] = False, False
    else:
        half = int(columns.mean()) + 1
        first[:, half:], second[:, :half] = False, False
    return _patches(first, good, detail) + _patches(second, good, detail)


def _best_shift(target: NDArray, good: NDArray, detail: NDArray) -> tuple[int, int] | None:
    """Find the shift in cells that moves all of `target` onto `good` and changes the detail around it least, if any."""
    rows, columns = np.nonzero(target)
    if len(rows) == 0:
        return None
    top, left = rows.min(), columns.min()
    shape = target[top : rows.max() + 1, left : columns.max() + 1].astype(np.float32)
    energy = (detail**2).sum(2)
    at = np.argwhere(_correlate(~good, shape, 1.0) < 0.5) - CELLS - (top, left)
    if len(at) == 0:
        return None
    band = np.argwhere(binary_dilation(target, iterations=BAND) & ~target & good)
    if len(band) == 0:
        nearest = at[np.abs(at).sum(1).argmin()]
        return int(nearest[0]), int(nearest[1])
    band = band[:: max(1, len(band) // 400)]
    there = (band[None] + at[:, None]).clip(0, CELLS - 1)
    fits = good[there[..., 0], there[..., 1]]
    changes = ((detail[there[..., 0], there[..., 1]] - detail[band[:, 0], band[:, 1]]) ** 2).sum(2)
    changes = np.where(fits, changes, 2.0 * float(energy[good].mean())).mean(1)
    # Prefer as much detail as in the surroundings: a patch that is neither plainer nor has an object on it.
    strength = _correlate(energy, shape, 0.0)[tuple((at + CELLS + (top, left)).T)] / shape.sum()
    best = at[(changes + np.abs(strength - energy[tuple(band.T)].mean())).argmin()]
    return int(best[0]), int(best[1])


def _correlate(values: NDArray, shape: NDArray, outside: float) -> NDArray:
    """Sum values (n, n), `outside` beyond them, over the cells of shape (h, w), for each position of its corner, with a
    margin of n cells on each side."""
    padded = np.pad(values.astype(np.float64), CELLS, constant_values=outside)
    sums = irfft2(rfft2(padded) * np.conj(rfft2(shape, padded.shape)), padded.shape)
    return sums[: len(padded) - len(shape) + 1, : len(padded) - shape.shape[1] + 1]
