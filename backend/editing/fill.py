"""Closing the ground or wall that a removed object hid: its surroundings, copied over the hole.

The object stands on, or at, planes that its neighbours' splats lie in, or near to where cloth is rumpled. Where it hid
such a plane, no photo says how it looks; a part of the same surface that does show is put there, with the detail
(grain, joints) that fits the hole's rim best, and with the colours and the relief around the hole, which shade and bend
it as its surroundings are. Where several things meet under the object, such as sheets of paper, each is continued by
straight edges.

Only a surface that lies around the whole hole is closed: the object may stand at its edge, which nobody can tell.
"""

from __future__ import annotations

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

from ..hull import body
from ..model.splats import Splats, concatenate
from ..spherical_harmonics import C0

PLANES = 3
"""An object may stand in a corner."""
NEAR = 0.5
"""How far around the object its planes are looked for, relative to its size."""
FLAT_WITHIN = (0.02, 0.04, 0.08)
"""Distance from a plane, relative to the object's size, within which splats lie in it; larger ones, for what is not
flat, where smaller ones leave the hole open."""
PART_OF_IT = 0.5
"""Share of another object's splats around the removed one that must lie in a plane, or it only stands on it."""
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
RELIEF_WITHIN = 0.03
"""Height above or below what is around, relative to the object's size, from which on something lies on the surface."""
SHELL = 0.06
"""Distance from the object's own splats, relative to its size, within which splats of the surface that stand above it
are the object's, wrongly labelled."""

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
    around = _Around(splats, solid - middle, middle, size)
    for within in FLAT_WITHIN:
        # Where the surface is rough, so are the labels: more of the object's lowest is taken for the surface's.
        rough = within / FLAT_WITHIN[0]
        planes = around.planes(within * size)
        for plane, flat in planes:
            surface = _Surface(plane, splats.select(flat), around.centred[flat], solid - middle, size, rough)
            replaced, patches = surface.closed(surface.beyond([other for other, _ in planes if other is not plane]))
            gone[flat[replaced]] = True
            if patches:
                gone[around.shell(flat, [each for each, _ in planes], within * size)] = True
            parts += patches
        if len(parts) > 1:
            break
    return gone, concatenate(parts)


class _Around:
    """The splats around a removed object, whose own are at solid (m, 3) from its `middle`. centred (N, 3): all splats
    from there; far (N,): how far from its nearest one, infinite beyond `NEAR`; near and reach: indices of those that
    may show its planes, and that planes may be continued from."""

    def __init__(self, splats: Splats, solid: NDArray, middle: NDArray, size: float) -> None:
        self.splats, self.solid, self.size = splats, solid, size
        self.centred = splats.means.astype(np.float64) - middle
        self.reach = np.flatnonzero(np.linalg.norm(self.centred, axis=1) < (1.0 + WINDOW) * size)
        self.far = np.full(len(splats), np.inf)
        self.far[self.reach] = cKDTree(solid).query(self.centred[self.reach], distance_upper_bound=NEAR * size)[0]
        self.near = np.flatnonzero(np.isfinite(self.far) & (splats.opacities > 0.3))
        self.thin = np.zeros_like(self.centred)
        self.thin[self.reach] = _thin_axes(splats.select(self.reach))

    def planes(self, within: float) -> list[tuple[_Plane, NDArray[np.int64]]]:
        """The planes that the object stands on or at, and the indices of the splats of what lies in each."""
        near = self.near
        found: list[tuple[_Plane, NDArray[np.int64]]] = []
        while len(found) < PLANES:
            before = [plane for plane, _ in found]
            plane = _plane(self.centred[near], self.thin[near], self.solid, self.size, within, before)
            if plane is None:
                break
            flat = np.abs(plane.height(self.centred)) < within
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
        """Splats of what lies in a plane, `flat`, that stand above all planes where the object was."""
        close = np.flatnonzero(self.far < SHELL * self.size)
        standing = np.all([plane.height(self.centred[close]) > within for plane in planes], axis=0)
        return close[standing & np.isin(self.splats.object_ids[close], np.unique(self.splats.object_ids[flat]))]


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


def _plane(
    points: NDArray, thin: NDArray, solid: NDArray, size: float, within: float, before: list[_Plane]
) -> _Plane | None:
    """The plane that most of points (n, 3) lie `within` of, with the splats' thin axes (n, 3) across it, and the
    object's own, solid (m, 3), stand on or at; or None. It is not parallel to those found before."""
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

    at (n, 2): their centres in cells; look (n, 4): base colour, and height above the plane in cells; owners: whose they
    are; under and touched (CELLS, CELLS): what the object hides and where it stands.
    """

    def __init__(
        self, plane: _Plane, splats: Splats, centred: NDArray, solid: NDArray, size: float, rough: float
    ) -> None:
        footprint = plane.flat(solid)
        low, high = footprint.min(0), footprint.max(0)
        width = WINDOW * float((high - low).max())
        self.plane, self.cell = plane, width / CELLS
        self.corner = corner = 0.5 * (low + high) - 0.5 * width
        self.at = (plane.flat(centred) - corner) / self.cell
        self.inside = ((self.at >= 0) & (self.at < CELLS)).all(1)
        self.splats = splats
        self.relief = RELIEF_WITHIN * size / self.cell
        height = plane.height(centred) / self.cell
        self.look = np.column_stack([0.5 + C0 * splats.sh[:, 0].astype(np.float64), height])
        self.owners, self.owner = np.unique(splats.object_ids, return_inverse=True)
        cells = ((footprint - corner) / self.cell).astype(int)
        self.under = _spread(cells)
        # No camera has seen what lies under what touches the plane, whatever splats there are.
        self.touched = _spread(cells[plane.height(solid) < rough * TOUCHES_WITHIN * size])

    def _seen(self) -> tuple[NDArray, NDArray, NDArray]:
        """The cells' alpha (CELLS, CELLS), mean look (CELLS, CELLS, 4), and which of `owners` one sees most of."""
        rotations = Rotation.from_quat(self.splats.quats.astype(np.float64), scalar_first=True).as_matrix()
        spread = self.plane.axes[:2] @ rotations * (self.splats.scales[:, None, :] / self.cell)
        covariance = spread @ spread.transpose(0, 2, 1) + 0.1 * np.eye(2)
        inverse = np.linalg.inv(covariance)
        radius = np.ceil(_REACH * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).max(1))).clip(1, _WIDEST)
        home = np.floor(self.at).astype(int)
        radius[((home < -_WIDEST) | (home >= CELLS + _WIDEST)).any(1)] = -1
        logs, looks = np.zeros((CELLS, CELLS)), np.zeros((CELLS, CELLS, 4))
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
                np.add.at(looks, cells, alpha[:, None] * self.look[reached])
        return 1.0 - np.exp(logs), looks / np.maximum(weights.sum(0), 1e-9)[..., None], weights.argmax(0)

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
        coverage, look, owner = self._seen()
        covered = gaussian_filter(coverage, 1.0) > COVERED
        whole = binary_fill_holes(binary_closing(covered | beyond, iterations=2)) & ~beyond
        hole = whole & (self.touched | (self.under & ~covered))
        enclosed = (whole & self.touched).sum() >= ENCLOSED * (self.touched & ~beyond).sum()
        if not hole.any() or not enclosed or covered.mean() < SURROUNDS:
            return np.zeros(0, np.int64), []
        target = binary_dilation(hole, iterations=RIM) & whole
        good = covered & ~binary_dilation(hole, iterations=RIM + 1)
        bump = np.abs(look[..., 3] - _smoothed(look[..., 3:], good, CELLS / 16)[..., 0]) > self.relief
        good &= ~binary_opening(bump, iterations=1)
        open_still, parts = target.copy(), []
        continued = _continued_owners(owner, good, hole)
        for i in np.unique(owner[good]):
            parts += self._continued(target & (continued == i), good & (owner == i), look, open_still)
        parts += self._continued(open_still.copy(), good, look, open_still)
        home = np.floor(self.at).astype(int)
        replaced = np.zeros(len(home), bool)
        replaced[self.inside] = (target & ~open_still)[tuple(home[self.inside].T)]
        return np.flatnonzero(replaced), parts

    def _continued(self, target: NDArray, good: NDArray, look: NDArray, open_still: NDArray) -> list[Splats]:
        """What is put onto the cells `target` from those that are good; `open_still` loses what that closes."""
        if not target.any() or not good.any():
            return []
        shades = _smoothed(look, good, max(BAND, 0.5 * np.sqrt(target.sum())))
        detail = np.where(good[..., None], look - shades, 0.0)[..., :3]
        parts = []
        for part, shift in _patches(target, good, detail):
            copied = self._copied(part, shift, shades)
            if len(copied):
                parts.append(copied)
                open_still &= ~part
        return parts

    def _copied(self, part: NDArray, shift: tuple[int, int], shades: NDArray) -> Splats:
        """The splats that lie where `part` is once it is shifted, put where it is, shaded and bent as it is there."""
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
        return replace(copies, means=means, sh=sh, invented=np.ones(len(copies), bool))


def _continued_owners(owner: NDArray, good: NDArray, hole: NDArray) -> NDArray[np.int64]:
    """Whose each cell (n, n) of the hole would be if what lies around it had straight edges: of the linear functions
    that tell the owners of good cells near the hole apart, the largest."""
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


def _smoothed(values: NDArray, good: NDArray, width: float) -> NDArray:
    """values (n, n, k) averaged around each cell over those that are good (n, n), by a Gaussian of this width in
    cells."""
    known = np.maximum(gaussian_filter(good.astype(float), width), 1e-9)
    of_good = np.where(good[..., None], values, 0.0)
    return np.stack([gaussian_filter(of_good[..., i], width) / known for i in range(values.shape[2])], 2)


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
    rows, columns = np.nonzero(target)
    if len(rows) == 0:
        return None
    top, left = rows.min(), columns.min()
    shape = target[top : rows.max() + 1, left : columns.max() + 1].astype(np.float32)
    energy = (detail**2).sum(2)
    at = np.argwhere(_summed(~good, shape, 1.0) < 0.5) - CELLS - (top, left)
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
    # Neither plainer than what is around, nor with things in it that are not.
    strength = _summed(energy, shape, 0.0)[tuple((at + CELLS + (top, left)).T)] / shape.sum()
    best = at[(changes + np.abs(strength - energy[tuple(band.T)].mean())).argmin()]
    return int(best[0]), int(best[1])


def _summed(values: NDArray, shape: NDArray, outside: float) -> NDArray:
    """The sum of values (n, n), `outside` beside them, over the cells of shape (h, w), for each place of its corner in
    them with a margin of n cells on each side."""
    padded = np.pad(values.astype(np.float64), CELLS, constant_values=outside)
    sums = irfft2(rfft2(padded) * np.conj(rfft2(shape, padded.shape)), padded.shape)
    return sums[: len(padded) - len(shape) + 1, : len(padded) - shape.shape[1] + 1]
