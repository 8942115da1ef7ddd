"""Points on large planes where photos show hardly any features, such as a plain table or wall.

COLMAP finds no points there, and patches without texture match anywhere. The points at the edges of such a surface, and
on spots of it, give its plane. Between them, the surface is assumed to go on wherever no photo shows points behind it
and photos show it in about the same color; and from there on as far as its color does not change abruptly.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError, cKDTree

from ..capture import Capture
from ..shared.stopping import Check, proceed
from ..stereo.scene_planes import ScenePlane, find_planes, on_plane
from ..stereo.surface_normals import measure_normals
from .coverage import CELLS, cells_of, examined_views, occupied_cells

LEAST = 0.1
"""Fraction of the photos' area that shows planes without features from which on points on them are worth it."""

_NEIGHBORS, _FEWEST_POINTS, _MOST_POINTS = 16, 50, 100_000
"""Number of nearest points that the normal of a point is measured on; fewest points of a plane; and largest number of
points, spread evenly, that planes are looked for among."""

_BEYOND = 1.0
"""How far a plane is looked for beyond its points, relative to their extent."""

_MOST_PLACES = 40_000
"""Largest number of places that are looked at on a plane; they are a cell of the views apart, or farther with more."""

_FEWEST_VIEWS, _VACANT = 3, 0.5
"""Fewest views that show a place, and smallest fraction of them without points there."""

_BEHIND, _CONTRADICTED = 0.05, 0.2
"""Relative distance from which on a point is behind a place, and largest fraction of views that show such points."""

_VARIES, _STEP = 20.0, 6.0
"""Largest median difference of a place's colors in the views from their median, and largest difference of neighboring
places of one surface, of 255."""

_FEWEST_PLACES = 20
"""Fewest places of a view that tell how bright its photo is."""

_OF_ALL = 0.1
"""Smallest fraction of the places between points of a plane from which its surface goes on beyond them."""


class PlanePoints(NamedTuple):
    """Points on planes without features.

    Attributes:
        xyz: (n, 3) float64, in world units.
        rgb: (n, 3) uint8.
        fraction: fraction of the photos' area that shows them and no other points.
    """

    xyz: np.ndarray
    rgb: np.ndarray
    fraction: float


class _Places(NamedTuple):
    """Places on a plane: xyz (rows, columns, 3), and which of them are between points of the plane (rows, columns)."""

    xyz: np.ndarray
    between: np.ndarray


class _Shown:
    """What a view shows of points: which cells have any, and the depths of the nearest, and farthest known to be seen.

    Args:
        capture: the capture.
        index: the view.
        xyz: (n, 3) all points.
    """

    def __init__(self, capture: Capture, index: int, xyz: np.ndarray) -> None:
        self.index, self.view = index, capture.views[index]
        self.occupied = occupied_cells(self.view, xyz)
        self.nearest, self.farthest = np.full(self.occupied.shape, np.inf), np.zeros(self.occupied.shape)
        self._add(xyz, np.minimum, self.nearest)
        self._add(capture.points.xyz[capture.observed(index)], np.maximum, self.farthest)

    def add(self, xyz: np.ndarray) -> None:
        """Add points (n, 3) of surfaces, about as far apart as cells."""
        self.occupied |= occupied_cells(self.view, xyz)
        nearest = np.full(self.occupied.shape, np.inf)
        self._add(xyz, np.minimum, nearest)
        # Without gaps in which what is behind would seem to be seen.
        np.minimum(self.nearest, ndimage.minimum_filter(nearest, 3), out=self.nearest)
        self._add(xyz, np.maximum, self.farthest)

    def _add(self, xyz: np.ndarray, choose: np.ufunc, depths: np.ndarray) -> None:
        local = self.view.to_camera(xyz)
        inside, rows, columns = cells_of(self.view, local, depths.shape)
        choose.at(depths, (rows, columns), local[inside, 2])


def find_plane_points(capture: Capture, more: np.ndarray, check: Check = proceed) -> PlanePoints:
    """Find points on planes of the scene where the training views of a capture show no other points.

    Args:
        capture: the capture; must be prepared.
        more: (n, 3) further points of surfaces, in world units.
        check: called at intervals; ends the work by an exception once the user wants to stop.

    Returns:
        The points, a plane after the other; xyz is empty if there are none.

    Raises:
        InputError: an image cannot be read.
    """
    views, xyz = examined_views(capture), np.concatenate([capture.points.xyz, more])
    found, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    if len(xyz) < max(_NEIGHBORS, _FEWEST_POINTS) or not views:
        return PlanePoints(found[0], colors[0], 0.0)
    centers = np.array([-capture.views[i].viewmat[:3, :3].T @ capture.views[i].viewmat[:3, 3] for i in views])
    cell = float(np.median([max(view.width, view.height) / CELLS / view.K[0, 0] for view in capture.views]))
    shown = [_Shown(capture, index, xyz) for index in views]
    before = float(np.mean([each.occupied.mean() for each in shown]))
    for places in _by_density(xyz[:: -(-len(xyz) // _MOST_POINTS)], centers, cell):
        check()
        kept, rgb = _surface(capture, shown, places, check)
        found.append(places.xyz[kept])
        colors.append(rgb[kept])
        for each in shown:
            each.add(found[-1])
    after = float(np.mean([each.occupied.mean() for each in shown]))
    return PlanePoints(np.concatenate(found), np.concatenate(colors), after - before)


def _by_density(xyz: np.ndarray, centers: np.ndarray, spacing: float) -> list[_Places]:
    """Return places on the planes of points, those with most points for their size first.

    A floor, of which photos show a few points far apart, may otherwise be found where a table hides it.

    Args:
        xyz: (n, 3) points.
        centers: (v, 3) positions of the cameras.
        spacing: distance between places, relative to the distance from which they are seen.
    """
    distances, nearest = cKDTree(centers).query(xyz)
    _, near = cKDTree(xyz).query(xyz, k=_NEIGHBORS)
    normals = measure_normals(xyz[near], centers[nearest] - xyz)
    found = []
    for plane in find_planes(xyz, normals, distances):
        on = on_plane(plane, xyz, normals, distances)
        if on.sum() < _FEWEST_POINTS:
            continue
        places = _places(plane, xyz[on], spacing * float(np.median(distances[on])))
        if places is not None and places.between.any():
            found.append((on.sum() / places.between.sum(), places))
    return [places for _, places in sorted(found, key=lambda each: -each[0])]


def _places(plane: ScenePlane, xyz: np.ndarray, spacing: float) -> _Places | None:
    """Return places on a plane around points (m, 3) near it, at a distance from each other; None if these are on a
    line."""
    across = np.cross(plane.normal, np.eye(3)[np.argmin(np.abs(plane.normal))])
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(plane.normal, across)])
    flat = (xyz - plane.center) @ axes.T
    try:
        hull = ConvexHull(flat)
    except QhullError:
        return None
    low, high = flat.min(0), flat.max(0)
    low, high = low - _BEYOND * (high - low), high + _BEYOND * (high - low)
    spacing = max(spacing, float(np.sqrt(np.prod(high - low) / _MOST_PLACES)))
    at = np.stack(np.meshgrid(*(np.arange(a, b, spacing) for a, b in zip(low, high, strict=True))), -1)
    between = (at @ hull.equations[:, :2].T + hull.equations[:, 2] <= 0).all(-1)
    return _Places(plane.center + at @ axes, between)


def _surface(capture: Capture, shown: Sequence[_Shown], places: _Places, check: Check) -> tuple[np.ndarray, np.ndarray]:
    """Return which places (rows, columns) views show as a surface without points, and their colors (..., 3) uint8."""
    xyz, shape = places.xyz.reshape(-1, 3), places.between.shape
    visible, vacant, behind = (np.zeros(len(xyz), np.int64) for _ in range(3))
    pixels: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for each in shown:
        check()
        local = each.view.to_camera(xyz)
        inside, rows, columns = cells_of(each.view, local, each.occupied.shape)
        _, x, y = each.view.pixels_of(local)
        free = each.nearest[rows, columns] > (1 - _BEHIND) * local[inside, 2]
        seen, rows, columns = inside[free], rows[free], columns[free]
        visible[seen] += 1
        vacant[seen] += ~each.occupied[rows, columns]
        behind[seen] += each.farthest[rows, columns] > (1 + _BEHIND) * local[seen, 2]
        pixels.append((seen, x[free], y[free]))
    good = (visible >= _FEWEST_VIEWS) & (vacant >= _VACANT * visible) & (behind <= _CONTRADICTED * visible)
    rgb = np.zeros((len(xyz), 3))
    if good.any():
        number_of = np.cumsum(good) - 1
        colors = np.full((len(shown), good.sum(), 3), np.nan, np.float32)
        for number, (each, (seen, x, y)) in enumerate(zip(shown, pixels, strict=True)):
            check()
            of_good = good[seen]
            if of_good.any():
                colors[number, number_of[seen[of_good]]] = capture.image(each.index)[y[of_good], x[of_good]]
        rgb[good], varies = _agreed(colors)
        good[good] = varies <= _VARIES
    image = rgb.reshape(*shape, 3)
    return _connected(good.reshape(shape), image, places.between), image.round().astype(np.uint8)


def _agreed(colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the medians (n, 3) of the colors of n places in v views (v, n, 3), NaN where a view does not show a place,
    and the median differences (n,) from them, each view's exposure and white balance aside."""
    middle = np.nanmedian(colors, axis=0)
    for of_view in colors:
        known = np.isfinite(of_view[:, 0])
        if known.sum() >= _FEWEST_PLACES:
            of_view /= np.median((of_view[known] + 1) / (middle[known] + 1), axis=0)
    return middle, np.nanmedian(np.abs(colors - np.nanmedian(colors, axis=0)), axis=0).max(1)


def _connected(good: np.ndarray, image: np.ndarray, between: np.ndarray) -> np.ndarray:
    """Return the good places (rows, columns) that are between points of their plane, and those that surfaces from there
    reach without a step in their colors (rows, columns, 3)."""
    number, pairs = np.arange(good.size).reshape(good.shape), []
    for first, second in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        linked = good[first] & good[second] & (np.abs(image[first] - image[second]).max(-1) <= _STEP)
        pairs.append((number[first][linked], number[second][linked]))
    i, j = (np.concatenate(ends) for ends in zip(*pairs, strict=True))
    labels = connected_components(coo_matrix((np.ones(len(i)), (i, j)), (good.size,) * 2), directed=False)[1]
    labels = labels.reshape(good.shape)
    inner = np.bincount(labels[good & between], minlength=good.size)
    return good & (between | (inner[labels] >= max(_OF_ALL * inner.sum(), 1)))
