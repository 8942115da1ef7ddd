"""Depth maps of the photos of a capture on coarse grids, and what they say about points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from PIL import Image as PilImage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ..capture import Capture, View
from ..shared.stopping import Check, proceed
from .comparison import compare
from .patch_match import RADIUS, Others, match, match_planes, packed
from .scene_planes import ScenePlane, find_planes

GRID = 6000
"""Number of pixels of each photo whose depth is looked for."""
LONGEST_SIDE = 640
"""Side in pixels to which larger photos are scaled."""
NEIGHBORS = 8
"""Largest number of other photos that a photo is matched with."""
NEIGHBORS_ON_PLANES = 32
"""The same where a photo shows one of the scene's large planes, which only few others may."""
CORRELATES = 0.6
"""Least correlation of patches that match."""
CORRELATES_ON_PLANES = 0.8
"""The same on a large plane of the scene."""
_BEYOND = 1.2
"""Distance from the center of a plane up to which it may go on, relative to its reach."""
AGREES = 0.015
"""Largest relative difference between the depths that two photos find at a point."""
IN_FRONT = 0.05
"""Relative difference from which on a point is in front of the surface that a photo shows."""
FEWEST = 2
"""Number of other photos that must find a depth, too."""
SPECKLE = 8
"""Fewest pixels of a grid that must form a surface."""
_SMOOTH = 0.02
"""Largest relative difference of the depths of neighboring pixels of a surface, along their planes."""
_MATCHING = 3
"""Time in which a photo is matched, relative to that in which it is matched on the large planes of the scene."""
_NEAREST_FARTHEST = 5, 99
_NEARER, _FARTHER = 0.6, 1.5
"""Percentiles of the depths of the capture's points before a view, and the range of depths relative to them."""
_FEWEST_SHOWN = 10
"""Fewest points that a view must have observed for its subject to be among them."""
_LEAST_ANGLE, _BEST_ANGLE, _LARGEST_ANGLE = 0.05, 0.2, 1.1
"""Angles in radians between neighboring photos, as seen from the scene."""


class DepthMap(NamedTuple):
    """Depths found in a view.

    Attributes:
        pixels: (n, 2) int64 columns and rows of a regular grid in the scaled photo, row by row.
        planes: (n, 3) float32, see `patch_match.Matches`.
        depths: (n,) float64, 0 where none was found.
        shape: rows and columns of the grid.
        stride: pixels between neighbors in the grid.
        K: (3, 3) of the scaled photo.
        scale: size of the scaled photo relative to the photo.
    """

    pixels: np.ndarray
    planes: np.ndarray
    depths: np.ndarray
    shape: tuple[int, int]
    stride: int
    K: np.ndarray
    scale: float

    def points(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions (m, 3) of the pixels with a depth, and their columns and rows (m, 2) in the photo."""
        found = np.flatnonzero(self.depths > 0)
        rays = np.column_stack([self.pixels[found] + 0.5, np.ones(len(found))]) @ np.linalg.inv(self.K).T
        local = rays * self.depths[found, None]
        at = np.floor((self.pixels[found] + 0.5) / self.scale).astype(np.int64)
        at = np.clip(at, 0, [view.width - 1, view.height - 1])
        return (local - view.viewmat[:3, 3]) @ view.viewmat[:3, :3], at

    def normals(self, view: View) -> np.ndarray:
        """Return the unit normals (m, 3) of the surfaces in the pixels with a depth, of either sign."""
        found = np.flatnonzero(self.depths > 0)
        planes = self.planes[found].astype(np.float64)
        constant = planes[:, 0] - (planes[:, 1:] * (self.pixels[found] + 0.5)).sum(1)
        local = np.column_stack([planes[:, 1:], constant]) @ self.K
        return local / np.linalg.norm(local, axis=1, keepdims=True) @ view.viewmat[:3, :3]

    def compare(self, view: View, xyz: np.ndarray) -> np.ndarray:
        """Return, for points (n, 3), 1 where the view shows a surface there, -1 where it shows one behind, else 0."""
        result = np.empty(len(xyz), np.int64)
        compare(
            np.require(xyz, np.float64, ["C", "W"]), self.K @ view.viewmat[:3], RADIUS, self.stride, *self.shape,
            self.depths, self.planes, self.pixels, IN_FRONT, AGREES, result,
        )  # fmt: skip
        return result


def find_depth_maps(
    capture: Capture, views: Sequence[int], progress: Callable[[int, int], None] = lambda _done, _total: None
) -> dict[int, DepthMap]:
    """Find the depths on which photos agree.

    Args:
        capture: the capture; must be prepared.
        views: indices of the views to use.
        progress: called with the work done, and all of it, before each photo, and each map that points are compared to.

    Returns:
        The depth maps of the views that others overlap. Depths that fewer than FEWEST others find are left out, as are
        those in front of what more views show than agree, and small islands of depths. Where large planes of the scene,
        such as its floor, go on to the borders of photos, other photos must match there, but need not find them.

    Raises:
        InputError: a photo cannot be read.
    """
    matched, total = _MATCHING * len(views), (_MATCHING + 1) * len(views)
    scaled = {}
    for index in views:
        progress(0, total)
        scaled[index] = _gray(capture, index)
    neighbors = _neighbors(capture, views, NEIGHBORS)
    raw: dict[int, DepthMap] = {}
    for number, index in enumerate(views):
        progress(_MATCHING * number, total)
        found = _depth_map(capture, scaled, index, neighbors[index])
        if found is not None:
            raw[index] = found
    agreed: dict[int, DepthMap] = {}
    for index, found in raw.items():
        progress(matched, total)
        others = {other: raw[other] for other in neighbors[index] if other in raw}
        xyz, _ = found.points(capture.views[index])
        agreed[index] = _without_speckles(_restricted(found, _agreeing(capture, others, xyz) >= FEWEST))
    result = {}
    for index, found in agreed.items():
        xyz, _ = found.points(capture.views[index])
        score = balance(capture, agreed, xyz, index, lambda: progress(matched, total))
        result[index] = _restricted(found, score > 0)
    return _with_planes(capture, scaled, result, lambda done: progress(matched + done, total))


def balance(
    capture: Capture, maps: dict[int, DepthMap], xyz: np.ndarray, without: int | None = None, check: Check = proceed
) -> np.ndarray:
    """Count the views with a surface at each point, less those with one behind it.

    Args:
        capture: the views.
        maps: their depth maps.
        xyz: (n, 3) points.
        without: a view that is not counted.
        check: called before each map; ends the work by an exception once the user wants to stop.

    Returns:
        (n,) int64.
    """
    total = np.zeros(len(xyz), np.int64)
    for other, found in maps.items():
        check()
        if other != without:
            total += found.compare(capture.views[other], xyz)
    return total


def _with_planes(
    capture: Capture,
    scaled: dict[int, tuple[np.ndarray, float]],
    maps: dict[int, DepthMap],
    progress: Callable[[int], None],
) -> dict[int, DepthMap]:
    """Return depth maps with more depths, on the large planes of the scene; progress: called with the number done."""
    if not maps:
        return maps
    views = capture.views
    planes = find_planes(
        np.concatenate([found.points(views[index])[0] for index, found in maps.items()]),
        np.concatenate([found.normals(views[index]) for index, found in maps.items()]),
        np.concatenate([found.depths[found.depths > 0] for found in maps.values()]),
    )
    if not planes:
        return maps
    neighbors = _neighbors(capture, list(maps), NEIGHBORS_ON_PLANES)
    filled = {}
    for number, (index, found) in enumerate(maps.items()):
        progress(number)
        filled[index] = _without_speckles(_on_planes(capture, scaled, index, found, planes, neighbors[index]))
    result = {}
    for index, found in filled.items():
        before = maps[index]
        added = found._replace(depths=np.where(before.depths > 0, 0.0, found.depths))
        xyz, _ = added.points(views[index])
        score = balance(capture, filled, xyz, index, lambda: progress(len(maps)))
        depths_there = _restricted(added, score > 0).depths
        result[index] = found._replace(depths=np.where(before.depths > 0, before.depths, depths_there))
    return result


def _on_planes(
    capture: Capture,
    scaled: dict[int, tuple[np.ndarray, float]],
    index: int,
    found: DepthMap,
    planes: Sequence[ScenePlane],
    neighbors: list[int],
) -> DepthMap:
    """Return a depth map with the depths of planes where it has none, and patches on these match in other photos."""
    view, missing = capture.views[index], np.flatnonzero(found.depths == 0)
    if not neighbors or not len(missing):
        return found
    # n . x = d in the world is m . x = 1 before the camera, so that 1 / z = m . K^-1 (u, v, 1).
    local = np.array([view.viewmat[:3, :3] @ plane.normal for plane in planes])
    offsets = np.array([plane.offset for plane in planes]) + local @ view.viewmat[:3, 3]
    local /= np.where(np.abs(offsets) > 1e-12, offsets, 1e-12)[:, None]
    pixels = np.column_stack([found.pixels[missing] + 0.5, np.ones(len(missing))])
    rays = pixels @ np.linalg.inv(found.K).T
    inverse = rays @ local.T
    near, far = _depth_range(capture, index)
    allowed = (inverse > 1.0 / far) & (inverse < 1.0 / near)
    xyz = (rays[:, None] / np.where(allowed, inverse, 1.0)[:, :, None] - view.viewmat[:3, 3]) @ view.viewmat[:3, :3]
    distances = np.linalg.norm(xyz - [plane.center for plane in planes], axis=2)
    allowed &= distances < _BEYOND * np.array([plane.reach for plane in planes])
    matches = match_planes(
        scaled[index][0], found.pixels[missing], _others(capture, scaled, index, neighbors, found.K),
        local @ np.linalg.inv(found.K), allowed,
    )  # fmt: skip
    good = matches.scores >= CORRELATES_ON_PLANES
    depths, slopes = found.depths.copy(), found.planes.copy()
    slopes[missing[good]] = matches.planes[good]
    depths[missing[good]] = 1.0 / matches.planes[good, 0].astype(np.float64)
    return found._replace(depths=depths, planes=slopes)


def _agreeing(capture: Capture, others: dict[int, DepthMap], xyz: np.ndarray) -> np.ndarray:
    """Count the views with a surface at each point (n, 3), (n,) int64."""
    total = np.zeros(len(xyz), np.int64)
    for other, found in others.items():
        total += found.compare(capture.views[other], xyz) > 0
    return total


def _restricted(found: DepthMap, good: np.ndarray) -> DepthMap:
    """Return a depth map with the depths that are good, (m,) bool of those that it has."""
    depths = found.depths.copy()
    depths[np.flatnonzero(depths > 0)[~good]] = 0.0
    return found._replace(depths=depths)


def _without_speckles(found: DepthMap) -> DepthMap:
    """Return a depth map without surfaces of fewer than SPECKLE pixels."""
    rows, columns = found.shape
    number = np.arange(rows * columns).reshape(rows, columns)
    pairs = []
    for first, second, slope in (
        (number[:, :-1].ravel(), number[:, 1:].ravel(), found.planes[:, 1]),
        (number[:-1].ravel(), number[1:].ravel(), found.planes[:, 2]),
    ):
        known = (found.depths[first] > 0) & (found.depths[second] > 0)
        first, second = first[known], second[known]
        here, there = found.planes[first, 0], found.planes[second, 0]
        apart = np.minimum(
            np.abs(here + found.stride * slope[first] - there), np.abs(there - found.stride * slope[second] - here)
        )
        close = apart < _SMOOTH * np.minimum(here, there)
        pairs.append((first[close], second[close]))
    i, j = (np.concatenate(ends) for ends in zip(*pairs, strict=True))
    labels = connected_components(coo_matrix((np.ones(len(i)), (i, j)), (rows * columns,) * 2), directed=False)[1]
    large = np.bincount(labels)[labels] >= SPECKLE
    return found._replace(depths=np.where(large, found.depths, 0.0))


def _gray(capture: Capture, index: int) -> tuple[np.ndarray, float]:
    """Return the packed gray levels (h, w) of a photo, scaled down if it is large, and the factor."""
    image = PilImage.fromarray(capture.image(index)).convert("F")
    factor = min(1.0, LONGEST_SIDE / max(image.size))
    if factor < 1.0:
        image = image.resize([max(round(side * factor), 1) for side in image.size], PilImage.Resampling.BOX)
    return packed(np.asarray(image)), factor


def _neighbors(capture: Capture, views: Sequence[int], most: int) -> dict[int, list[int]]:
    """Return, for each view, at most as many others that show the same from a little aside, the best angle first."""
    matrices = np.array([capture.views[index].viewmat for index in views]).reshape(-1, 4, 4)
    centers = -np.einsum("nij,ni->nj", matrices[:, :3, :3], matrices[:, :3, 3])
    axes = matrices[:, 2, :3]
    found = {}
    for place, index in enumerate(views):
        depths = _depths_shown(capture, index)
        subject = centers[place] + axes[place] * (np.median(depths) if len(depths) else 1.0)
        rays = centers - subject
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles = np.arccos(np.clip(rays @ rays[place], -1.0, 1.0))
        usable = (angles > _LEAST_ANGLE) & (angles < _LARGEST_ANGLE) & (axes @ axes[place] > 0.5)
        order = np.argsort(np.where(usable, np.abs(angles - _BEST_ANGLE), np.inf), kind="stable")
        found[index] = [views[other] for other in order[:most] if usable[other]]
    return found


def _depth_map(
    capture: Capture, scaled: dict[int, tuple[np.ndarray, float]], index: int, neighbors: list[int]
) -> DepthMap | None:
    """Return the depths of a view, not compared with others; None without neighbors, points, or room for a patch."""
    image, scale = scaled[index]
    view, (height, width) = capture.views[index], image.shape
    stride = max(int(np.ceil(np.sqrt(height * width / GRID))), 1)
    rows, columns = (np.arange(RADIUS, side - RADIUS, stride) for side in (height, width))
    near, far = _depth_range(capture, index)
    if not neighbors or not far > 0 or min(len(rows), len(columns)) < 2:
        return None
    pixels = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    K = _scaled_intrinsics(view, image)
    others = _others(capture, scaled, index, neighbors, K)
    matches = match(image, pixels, len(columns), others, near, far, K[0, 0])
    inverse = matches.planes[:, 0].astype(np.float64)
    good = (matches.scores >= CORRELATES) & (inverse > 1.0 / far) & (inverse < 1.0 / near)
    depths = np.where(good, 1.0 / np.where(good, inverse, 1.0), 0.0)
    return DepthMap(pixels, matches.planes, depths, (len(rows), len(columns)), stride, K, scale)


def _depth_range(capture: Capture, index: int) -> tuple[float, float]:
    """Return the range of depths in which surfaces are looked for; 0 if no point is in front of the camera.

    It includes those of all points, since the ones that a view observed may be few.
    """
    known = _depths_of(capture, index, slice(None))
    if not len(known):
        return 0.0, 0.0
    ranges = [np.percentile(depths, _NEAREST_FARTHEST) for depths in (known, _depths_shown(capture, index))]
    return _NEARER * float(min(near for near, _ in ranges)), _FARTHER * float(max(far for _, far in ranges))


def _depths_shown(capture: Capture, index: int) -> np.ndarray:
    """Return the depths (n,) of the points that a view observed, or of all in front of it if these are few.

    Behind walls and outside the view, there may be many more, at other depths.
    """
    shown = _depths_of(capture, index, capture.observed(index))
    return shown if len(shown) >= _FEWEST_SHOWN else _depths_of(capture, index, slice(None))


def _depths_of(capture: Capture, index: int, points: np.ndarray | slice) -> np.ndarray:
    """Return the depths (n,) of those of the given points that are in front of a view."""
    view = capture.views[index]
    depths = capture.points.xyz[points] @ view.viewmat[2, :3] + view.viewmat[2, 3]
    return depths[depths > 0]


def _others(
    capture: Capture, scaled: dict[int, tuple[np.ndarray, float]], index: int, neighbors: list[int], K: np.ndarray
) -> Others:
    """Return the photos that a view is matched with; K: (3, 3) of its scaled photo."""
    theirs = np.array([_scaled_intrinsics(capture.views[other], scaled[other][0]) for other in neighbors])
    between = np.array([capture.views[other].viewmat for other in neighbors]) @ np.linalg.inv(
        capture.views[index].viewmat
    )
    sizes = np.array([scaled[other][0].shape for other in neighbors], np.int64)
    images = np.zeros((len(neighbors), *sizes.max(0)), np.int32)
    for number, other in enumerate(neighbors):
        images[number, : sizes[number, 0], : sizes[number, 1]] = scaled[other][0]
    return Others(
        np.ascontiguousarray(theirs @ between[:, :3, :3] @ np.linalg.inv(K), np.float32),
        np.einsum("nij,nj->ni", theirs, between[:, :3, 3]).astype(np.float32), images, sizes,
    )  # fmt: skip


def _scaled_intrinsics(view: View, image: np.ndarray) -> np.ndarray:
    height, width = image.shape
    return np.diag([width / view.width, height / view.height, 1.0]) @ view.K
