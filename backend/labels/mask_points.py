"""Points for objects that no point of the capture belongs to, placed where the object's masks agree.

COLMAP finds no points on objects without texture. Since new anchors keep the ID of their parent (ObjectGS section 3.2),
an object without points could never appear. Its masks bound it, though: where the rays through the pixels of one mask
enter the space that the other masks agree on (the visual hull, Laurentini 1994), points of the object are placed.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from ..capture import Capture
from ..shared.class_table import ClassTable
from ..shared.events import Reporter
from ..shared.stopping import Check

MOST_POINTS = 400
"""Largest number of points for an object."""

_VIEWS, _PIXELS, _DEPTHS = 12, 100, 96
"""Largest number of views that rays start from, of rays in a view, and number of depths tried along a ray."""

_AGREEMENT = 0.8
"""Smallest fraction of the views that show the object, and the position, whose masks have to agree on a position."""

_NEARER, _FARTHER = 0.5, 1.5
"""Range of the depths along a ray, relative to those of the capture's points in the view."""


class MaskPoints(NamedTuple):
    """Points placed for objects: xyz (M, 3) float64 in world units, rgb (M, 3) uint8, ids (M,) int64."""

    xyz: np.ndarray
    rgb: np.ndarray
    ids: np.ndarray


class _Shown(NamedTuple):
    """Where a mask shows an object: inside (h, w) bool, in the window whose first row and column are top and left."""

    top: int
    left: int
    inside: np.ndarray

    def shows(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return whether the mask shows the object at pixels (n,): (n,) bool."""
        rows, columns = rows - self.top, columns - self.left
        height, width = self.inside.shape
        result = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        result[result] = self.inside[rows[result], columns[result]]
        return result


class _Masks:
    """The masks of the training views that show any of some objects, each read once.

    Attributes:
        shown: for each object and view whose mask lists it, where.
        ignored: for each view with pixels of no known object, these: (H, (W + 7) // 8) uint8, eight pixels a byte.
    """

    def __init__(self, capture: Capture, object_ids: Sequence[int], check: Check) -> None:
        self.shown: dict[int, dict[int, _Shown]] = {object_id: {} for object_id in object_ids}
        self.ignored: dict[int, np.ndarray] = {}
        wanted = ClassTable(list(object_ids))
        for index in capture.train_indices:
            listed = sorted(set(capture.ids_in(index)) & set(self.shown))
            mask = capture.mask(index) if listed else None
            if mask is None:
                continue
            check()
            windows = ndimage.find_objects(wanted.classes_of(mask) + 1, len(wanted))
            for object_id in listed:
                window = windows[int(wanted.classes_of(object_id))] or (slice(0, 0), slice(0, 0))
                self.shown[object_id][index] = _Shown(window[0].start, window[1].start, mask[window] == object_id)
            if (mask < 0).any():
                self.ignored[index] = np.packbits(mask < 0, axis=1)

    def knows(self, index: int, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return whether a view's mask tells what pixels (n,) show: (n,) bool."""
        if index not in self.ignored:
            return np.ones(len(rows), np.bool_)
        return (self.ignored[index][rows, columns >> 3] >> (7 - (columns & 7))) & 1 == 0


def place_points(
    capture: Capture, object_ids: Sequence[int], seed: int = 0, reporter: Reporter | None = None
) -> MaskPoints:
    """Place points of objects where their masks in the training views agree.

    Args:
        capture: The capture; must be prepared.
        object_ids: The objects.
        seed: For the choice of pixels and points.
        reporter: Receives progress; its check ends the work by an exception once the user wants to stop.

    Returns:
        Up to MOST_POINTS points for each object; none for an object whose masks agree nowhere or that fewer than two
        views show.
    """
    reporter = reporter or Reporter()
    masks = _Masks(capture, object_ids, reporter.check)
    depths = functools.cache(lambda index: _depths(capture, index))
    parts = []
    for done, object_id in enumerate(object_ids, 1):
        parts.append(_points_of(capture, masks, object_id, depths, np.random.default_rng([seed, object_id])))
        reporter.progress(done, len(object_ids), what="objects")
    found = [(xyz, rgb, np.full(len(xyz), i, np.int64)) for (xyz, rgb), i in zip(parts, object_ids, strict=True)]
    nothing = (np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, np.int64))
    return MaskPoints(*(np.concatenate(columns) for columns in zip(nothing, *found, strict=True)))


def _points_of(
    capture: Capture,
    masks: _Masks,
    object_id: int,
    depths: Callable[[int], np.ndarray],
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions (M, 3) and colors (M, 3) of the points of one object; depths: `_depths` of a view."""
    shown = masks.shown[object_id]
    if len(shown) < 2:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    chosen = np.unique(np.linspace(0, len(shown) - 1, min(len(shown), _VIEWS)).astype(int))
    positions, colors = [], []
    for index in np.array(list(shown))[chosen].tolist():
        rays, seen = _rays(capture, index, shown[index], depths(index), rng)
        agreed = _agreement(capture, masks, object_id, rays.reshape(-1, 3)).reshape(rays.shape[:2]) >= _AGREEMENT
        hit = agreed.any(1)
        positions.append(rays[hit, agreed[hit].argmax(1)])
        colors.append(seen[hit])
    xyz, rgb = np.concatenate(positions), np.concatenate(colors)
    keep = np.sort(rng.permutation(len(xyz))[:MOST_POINTS])
    return xyz[keep], rgb[keep]


def _depths(capture: Capture, index: int) -> np.ndarray:
    """Return the depths (_DEPTHS,) that are tried along the rays of a view."""
    view = capture.views[index]
    depths = capture.points.xyz @ view.viewmat[2, :3] + view.viewmat[2, 3]
    near, far = np.percentile(depths[depths > 0], [1, 99]) if (depths > 0).any() else (0.1, 10.0)
    return np.geomspace(_NEARER * near, _FARTHER * far, _DEPTHS)


def _rays(
    capture: Capture, index: int, shown: _Shown, depths: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions at depths along the rays of pixels that show an object, (n, _DEPTHS, 3), and their colors."""
    view = capture.views[index]
    rows, columns = np.nonzero(shown.inside)
    picked = rng.permutation(len(rows))[:_PIXELS]
    rows, columns = rows[picked] + shown.top, columns[picked] + shown.left
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], 1)
    directions = pixels @ np.linalg.inv(view.K).T
    in_camera = directions[:, None] * depths[:, None]
    return (in_camera - view.viewmat[:3, 3]) @ view.viewmat[:3, :3], capture.image(index)[rows, columns]


def _agreement(capture: Capture, masks: _Masks, object_id: int, xyz: np.ndarray) -> np.ndarray:
    """Return the fraction (n,) of the views with the positions (n, 3) inside whose masks show the object there.

    Views that tell nothing of a position do not count. Where fewer than two views count, it is 0.
    """
    inside, agreeing = np.zeros(len(xyz), np.int64), np.zeros(len(xyz), np.int64)
    for index, shown in masks.shown[object_id].items():
        view = capture.views[index]
        found, columns, rows = view.pixels_of(view.to_camera(xyz))
        known = masks.knows(index, rows, columns)
        found, columns, rows = found[known], columns[known], rows[known]
        inside[found] += 1
        agreeing[found] += shown.shows(rows, columns)
    return np.where(inside >= 2, agreeing / np.maximum(inside, 1), 0.0)
