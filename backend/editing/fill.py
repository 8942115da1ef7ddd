"""Closing the ground or wall that a removed object hid: its surroundings, copied over the hole.

The object stands on, or at, planes that its neighbours' splats lie in. Where it hid such a plane, no photo says how it
looks; a part of the same plane that does show is put there, with the detail (grain, joints) that fits the hole's rim
best, and with the colours around the hole, which shade it as its surroundings are.

Only flat ground or walls that belong to one object (or to none) and lie around the whole hole are closed: a rumpled
cloth, or several sheets of paper that meet under the object, stay as they were trained.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, binary_dilation, binary_fill_holes, gaussian_filter, map_coordinates
from scipy.signal import correlate
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ..hull import body
from ..model.splats import Splats, concatenate
from ..spherical_harmonics import C0

PLANES = 3
"""An object may stand in a corner."""
NEAR = 0.5
"""How far around the object its planes are looked for, relative to its size."""
FLAT_WITHIN = 0.02
"""Distance from a plane, relative to the object's size, within which splats lie in it."""
LOWEST_PERCENT = 3.0
TOUCHES_WITHIN = 0.1
"""So near to a plane that it stands on, relative to its size, its lowest percent must come, and not below."""
FEWEST = 60
"""Fewer splats than this make no plane."""
ALIGNED = 0.7
"""Cosine, at least, between a plane's normal and the axis along which a splat in it is thinnest."""
COVERED = 0.3
"""Alpha, seen from straight above, from which on a plane is no hole: much of what makes it opaque lies deeper."""
WINDOW = 3.0
"""Width of the surroundings that a patch may come from, relative to the object's footprint."""
CELLS = 128
"""Cells across the window."""
SURROUNDS = 0.2
"""Share of the window that a plane must cover, or it is a side of something small."""
ENCLOSED = 0.5
"""Share of what the object touches that must lie within the plane, or it stands at its edge, which nobody can tell."""
RIM = 2
"""Cells around the hole that are replaced too: what is seen there is half the object's own."""
BAND = 5
"""Cells around the hole by which a patch is chosen."""
SMALLEST_PATCH = 4

_TRIPLES = 600
_SCORED = 3000
_REACH = 3.0
_WIDEST = 16


def closing(splats: Splats, removed: Splats) -> tuple[NDArray[np.bool_], Splats]:
    """What closes the holes that an object leaves in `splats`, which are without its own, `removed`: which of them give
    way at the holes' rims (N,), and the invented ones that come, with the IDs of the surface that they continue."""
    gone, parts = np.zeros(len(splats), bool), [Splats.empty(splats.degree)]
    solid = body(removed.means, removed.opacities)
    if len(solid) < FEWEST:
        return gone, parts[0]
    size = float(np.linalg.norm(np.percentile(solid, 95, axis=0) - np.percentile(solid, 5, axis=0)))
    middle = np.median(solid, axis=0)
    centred = splats.means.astype(np.float64) - middle
    reach = np.flatnonzero(np.linalg.norm(centred, axis=1) < (1.0 + WINDOW) * size)
    distances, _ = cKDTree(solid - middle).query(centred[reach], distance_upper_bound=NEAR * size)
    near = reach[np.isfinite(distances) & (splats.opacities[reach] > 0.3)]
    thin = np.zeros_like(centred)
    thin[reach] = _thin_axes(splats.select(reach))
    planes: list[_Plane] = []
    flats = []
    while len(planes) < PLANES and (plane := _plane(centred[near], thin[near], solid - middle, size, planes)):
        within = np.abs(plane.height(centred)) < FLAT_WITHIN * size
        owners, counts = np.unique(splats.object_ids[near[within[near]]], return_counts=True)
        near = near[~within[near]]
        planes.append(plane)
        flats.append(reach[within[reach] & (splats.object_ids[reach] == owners[counts.argmax()])])
    for plane, flat in zip(planes, flats):
        surface = _Surface(plane, splats.select(flat), centred[flat], solid - middle, size)
        beyond = surface.beyond([other for other in planes if other is not plane])
        replaced, patches = surface.closed(beyond)
        gone[flat[replaced]] = True
        parts += patches
    return gone, concatenate(parts)


@dataclass(frozen=True)
class _Plane:
    """A plane through `point` (3,); axes (3, 3): two rows in it, the third its normal, towards the object."""

    point: NDArray
    axes: NDArray

    def height(self, points: NDArray) -> NDArray:
        """How far points (n, 3) are above it: (n,)."""
        return (points - self.point) @ self.axes[2]

    def flat(self, points: NDArray) -> NDArray:
        """Points (n, 3) in it: (n, 2)."""
        return (points - self.point) @ self.axes[:2].T


def _thin_axes(splats: Splats) -> NDArray[np.float64]:
    """The direction in which each splat is thinnest: (N, 3)."""
    axes = Rotation.from_quat(splats.quats.astype(np.float64), scalar_first=True).as_matrix()
    return np.take_along_axis(axes, splats.scales.argmin(1)[:, None, None], 2)[:, :, 0]


def _plane(points: NDArray, thin: NDArray, solid: NDArray, size: float, before: list[_Plane]) -> _Plane | None:
    """The plane that most of points (n, 3) lie in, with the splats' thin axes (n, 3) across it, and the object's own,
    solid (m, 3), stand on or at; or None. It is not parallel to those found before."""
    if len(points) < FEWEST:
        return None
    within = FLAT_WITHIN * size
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
        parallel = any(abs(other.axes[2] @ normal) > ALIGNED for other in before)
        if parallel or not -within <= lowest <= TOUCHES_WITHIN * size:
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
    return _Plane(point, axes)


class _Surface:
    """The splats that lie in a plane, seen from straight above on a grid of square cells around the object.

    at (n, 2): their centres in cells; under and touched (CELLS, CELLS): what the object hides and where it stands.
    """

    def __init__(self, plane: _Plane, splats: Splats, centred: NDArray, solid: NDArray, size: float) -> None:
        footprint = plane.flat(solid)
        low, high = footprint.min(0), footprint.max(0)
        width = WINDOW * float((high - low).max())
        self.plane, self.cell = plane, width / CELLS
        self.corner = corner = 0.5 * (low + high) - 0.5 * width
        self.at = (plane.flat(centred) - corner) / self.cell
        self.inside = ((self.at >= 0) & (self.at < CELLS)).all(1)
        self.splats = splats
        self.base = 0.5 + C0 * splats.sh[:, 0].astype(np.float64)
        cells = ((footprint - corner) / self.cell).astype(int)
        self.under = _spread(cells)
        # No camera has seen what lies under what touches the plane, whatever splats there are.
        self.touched = _spread(cells[plane.height(solid) < TOUCHES_WITHIN * size])

    def _seen(self) -> tuple[NDArray, NDArray]:
        """The cells' alpha (CELLS, CELLS) and mean base colour (CELLS, CELLS, 3)."""
        rotations = Rotation.from_quat(self.splats.quats.astype(np.float64), scalar_first=True).as_matrix()
        spread = self.plane.axes[:2] @ rotations * (self.splats.scales[:, None, :] / self.cell)
        covariance = spread @ spread.transpose(0, 2, 1) + 0.1 * np.eye(2)
        inverse = np.linalg.inv(covariance)
        radius = np.ceil(_REACH * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).max(1))).clip(1, _WIDEST)
        home = np.floor(self.at).astype(int)
        radius[((home < -_WIDEST) | (home >= CELLS + _WIDEST)).any(1)] = -1
        logs, weights = np.zeros((CELLS, CELLS)), np.zeros((CELLS, CELLS))
        colours = np.zeros((CELLS, CELLS, 3))
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
                np.add.at(weights, cells, alpha)
                np.add.at(colours, cells, alpha[:, None] * self.base[reached])
        return 1.0 - np.exp(logs), colours / np.maximum(weights, 1e-9)[..., None]

    def beyond(self, others: list[_Plane]) -> NDArray[np.bool_]:
        """The cells (CELLS, CELLS) on the far side of other planes, where this one has nothing to close."""
        flat = np.stack(np.meshgrid(*2 * [np.arange(CELLS) + 0.5], indexing="ij"), 2) * self.cell + self.corner
        places = flat @ self.plane.axes[:2] + self.plane.point
        found = np.zeros((CELLS, CELLS), bool)
        for other in others:
            found |= other.height(places) < 0.0
        return found

    def closed(self, beyond: NDArray) -> tuple[NDArray[np.int64], list[Splats]]:
        """Which splats give way, as indices, and what is put there; the cells `beyond` are none of its own."""
        coarse = np.unique(self.at[self.inside] // (CELLS // 16), axis=0)
        if len(coarse) < SURROUNDS * 16 * 16:
            return np.zeros(0, np.int64), []
        coverage, colour = self._seen()
        covered = gaussian_filter(coverage, 1.0) > COVERED
        whole = binary_fill_holes(binary_closing(covered | beyond, iterations=2)) & ~beyond
        hole = whole & (self.touched | (self.under & ~covered))
        enclosed = (whole & self.touched).sum() >= ENCLOSED * (self.touched & ~beyond).sum()
        if not hole.any() or not enclosed or covered.mean() < SURROUNDS:
            return np.zeros(0, np.int64), []
        target = binary_dilation(hole, iterations=RIM) & whole
        good = covered & ~binary_dilation(hole, iterations=RIM + 1)
        smooth = max(BAND, 0.5 * np.sqrt(target.sum()))
        known = gaussian_filter(good.astype(float), smooth)
        shades = np.stack(
            [gaussian_filter(np.where(good, colour[..., i], 0.0), smooth) for i in range(3)], 2
        ) / np.maximum(known, 1e-9)[..., None]  # fmt: skip
        detail = np.where(good[..., None], colour - shades, 0.0)
        parts = [self._copied(part, shift, shades) for part, shift in _patches(target, good, detail)]
        home = np.floor(self.at).astype(int)
        replaced = np.zeros(len(home), bool)
        replaced[self.inside] = target[tuple(home[self.inside].T)]
        return (np.flatnonzero(replaced) if parts else np.zeros(0, np.int64)), parts

    def _copied(self, part: NDArray, shift: tuple[int, int], shades: NDArray) -> Splats:
        """The splats that lie where `part` is once it is shifted, put where it is, and shaded as it is there."""
        target = self.at - shift
        home = np.floor(target).astype(int)
        mine = self.inside & ((home >= 0) & (home < CELLS)).all(1)
        mine[mine] = part[tuple(home[mine].T)]
        copies = self.splats.select(mine)
        sh = copies.sh.copy()
        for i in range(3):
            there, here = (
                map_coordinates(shades[..., i], (places[mine] - 0.5).T, order=1, mode="nearest")
                for places in (target, self.at)
            )
            sh[:, 0, i] += (there - here) / C0
        back = -self.cell * np.array(shift, np.float64) @ self.plane.axes[:2]
        means = (copies.means + back).astype(copies.means.dtype)
        return replace(copies, means=means, sh=sh, invented=np.ones(len(copies), bool))


def _spread(cells: NDArray) -> NDArray[np.bool_]:
    """The cells (CELLS, CELLS) among and within cells (n, 2)."""
    found = np.zeros((CELLS, CELLS), bool)
    found[tuple(cells.clip(0, CELLS - 1).T)] = True
    return binary_fill_holes(binary_closing(found, iterations=6))


def _patches(target: NDArray, good: NDArray, detail: NDArray) -> list[tuple[NDArray, tuple[int, int]]]:
    """The cells to fill, target (n, n), in parts, each with the shift to the part of `good` whose detail fits its rim
    best; cells that nothing fits are left out."""
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
    """The shift, in cells, that takes all of `target` onto `good` and changes the detail around it least; or None."""
    bad = np.pad((~good).astype(np.float32), CELLS, constant_values=1.0)
    rows, columns = np.nonzero(target)
    if len(rows) == 0:
        return None
    top, left = rows.min(), columns.min()
    shape = target[top : rows.max() + 1, left : columns.max() + 1].astype(np.float32)
    misses = correlate(bad, shape, mode="valid", method="fft")
    at = np.argwhere(misses < 0.5) - CELLS - (top, left)
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
    typical = float((detail[good] ** 2).sum(1).mean()) * 2.0
    best = at[np.where(fits, changes, typical).mean(1).argmin()]
    return int(best[0]), int(best[1])
