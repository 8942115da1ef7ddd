"""Corrections of masks by the votes: regions whose ID contradicts the objects of the points observed in them.

The ID loss of ObjectGS (section 3.3) takes every mask as true. Since splats keep their IDs, a mask that gives an object
a wrong ID can only be followed by making the object transparent. The votes of all views tell such masks apart.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from ..capture import Capture
from ..shared.class_table import ClassTable
from ..shared.stopping import Check, proceed
from .voting import find_observed_points

IGNORED = -1
"""ID of the pixels of a corrected mask that show no known object and are not supervised."""

_ENOUGH_POINTS = 10
"""Points from which on a region is judged."""

_OTHER, _OWN = 0.7, 0.1
"""A region is wrong if at least the first fraction of its points belongs to one other object, or to none, or at most
the second one to the object of its ID. An object of few points, at whose borders others show, is neither."""

_MOSTLY_WRONG = 0.6
"""An ID is not corrected if it seems wrong in more than this fraction of the views whose points tell: its object has
hardly any points, so that those behind it show through."""

_THIN = 0.01
"""Half the width of unlabeled strips that are gaps between masks, relative to the longer side of a view."""

_NEAR = 2.5
"""Distance of the pixels of a gap from points of objects, relative to the average distance between observed points."""

_NEIGHBORS, _AGREEING = 5, 4
"""A pixel of a wrong region gets the object that this many of its nearest points in the region belong to; without one,
it is ignored."""


class Region(NamedTuple):
    """A connected region of one ID in a mask.

    object_id: its ID. window: the rows and columns that contain it. inside: (h, w) bool, its pixels in the window.
    x, y: (n,) int64, pixels of the points in it, relative to the window. ids: (n,) int64, the points' objects.
    """

    object_id: int
    window: tuple[slice, slice]
    inside: np.ndarray
    x: np.ndarray
    y: np.ndarray
    ids: np.ndarray

    @property
    def is_wrong(self) -> bool:
        """Whether its points contradict its ID."""
        found, counts = np.unique(self.ids, return_counts=True)
        most = counts.max() >= _OTHER * len(self.ids) and found[counts.argmax()] != self.object_id
        return bool(most or (self.ids == self.object_id).mean() <= _OWN)

    def corrected(self) -> np.ndarray:
        """Return the IDs of its pixels by the points that are nearest in the image: (pixels,) int64, or IGNORED."""
        pixels = np.stack(np.nonzero(self.inside), 1)
        count = min(_NEIGHBORS, len(self.ids))
        nearest = cKDTree(np.stack([self.y, self.x], 1)).query(pixels, count)[1].reshape(len(pixels), count)
        near = np.sort(self.ids[nearest], axis=1)
        middle = near[:, count // 2]
        agreeing = (near == middle[:, None]).sum(1)
        return np.where((agreeing >= _AGREEING) & (middle > 0), middle, IGNORED)


def correct_masks(
    capture: Capture, point_ids: np.ndarray, ignore_gaps: bool, check: Check = proceed
) -> tuple[Capture, int]:
    """Correct the masks of training and validation views where they contradict the votes.

    Args:
        capture: the capture; must be prepared. The masks of objects that are left out are judged as those of others.
        point_ids: (M,) int64, the objects of the capture's points by the votes of all objects.
        ignore_gaps: whether unlabeled pixels where objects should be are ignored, since other unlabeled pixels are
            supervised to show no object. So are those of objects that are left out, which are no gaps.
        check: called at intervals; ends the work by an exception once the user wants to stop.

    Returns:
        The capture whose `mask` returns the corrected IDs of these views, IGNORED where none is known, and the number
        of regions that are corrected. Held-out views are unchanged.
    """
    # Validation views are trained on in the end.
    views = (*capture.train_indices, *capture.validation_indices)
    whole, ids_of_gaps = capture.edited({}, ()), capture.without_left_out(point_ids)
    wrong = {}
    wrong_in: Counter[int] = Counter()
    right_in: Counter[int] = Counter()
    for index in views:
        check()
        wrong[index] = [region.object_id for region in _regions(whole, index, point_ids) if region.is_wrong]
        wrong_in.update(set(wrong[index]))
        right_in.update(_confirmed(whole, index, point_ids) - set(wrong[index]))
    kept = {each for each, views in wrong_in.items() if views > _MOSTLY_WRONG * (views + right_in[each])}
    wrong = {index: left for index, ids in wrong.items() if (left := [i for i in ids if i not in kept])}

    def correct(index: int, mask: np.ndarray) -> np.ndarray:
        result = mask.astype(np.int64)
        if index in wrong:
            for region in _regions(whole, index, point_ids):
                if region.object_id in wrong[index] and region.is_wrong:
                    result[region.window][region.inside] = region.corrected()
        if ignore_gaps:
            result[_gaps(whole, index, mask, ids_of_gaps)] = IGNORED
        return result

    regions = sum(map(len, wrong.values()))
    changed = {index for index in views if 0 in whole.ids_in(index)} if ignore_gaps else set()
    changed |= set(wrong)
    return (capture.with_corrected_masks(frozenset(changed), correct) if changed else capture), regions


def _gaps(capture: Capture, index: int, mask: np.ndarray, point_ids: np.ndarray) -> np.ndarray:
    """Find the unlabeled pixels of a view's mask that are gaps in it: thin strips, and pixels near points of objects.

    Points within a strip's width of the mask's borders are not considered, since they may be on the other side.

    Returns:
        (H, W) bool.
    """
    unlabeled = mask == 0
    if not unlabeled.any() or unlabeled.all():
        return np.zeros_like(unlabeled)
    radius = max(_THIN * max(mask.shape), 1.0)
    # What circles of this radius fit into (morphological opening).
    inside = ndimage.distance_transform_edt(unlabeled) > radius
    wide = unlabeled & (ndimage.distance_transform_edt(~inside) <= radius)
    points, x, y = find_observed_points(capture, index)
    missed = inside[y, x] & (point_ids[points] > 0)
    gaps = unlabeled & ~wide
    if missed.any():
        at = np.ones_like(unlabeled)
        at[y[missed], x[missed]] = False
        spacing = np.sqrt(mask.size / len(points))
        gaps |= unlabeled & (ndimage.distance_transform_edt(at) <= _NEAR * spacing)
    return gaps


def _confirmed(capture: Capture, index: int, point_ids: np.ndarray) -> set[int]:
    """Return the IDs in a view's mask whose objects own enough of the points there, however few these are."""
    mask = capture.uncorrected_mask(index)
    if mask is None:
        return set()
    points, x, y = find_observed_points(capture, index)
    at = mask[y, x]
    found, which = np.unique(at, return_inverse=True)
    own = np.bincount(which, at == point_ids[points], len(found))
    return set(found[own > _OWN * np.bincount(which, minlength=len(found))].tolist())


def _regions(capture: Capture, index: int, point_ids: np.ndarray) -> Iterator[Region]:
    """Yield the regions of a view's mask that have enough points, of IDs that some points in them contradict."""
    mask = capture.uncorrected_mask(index)
    if mask is None:
        return
    points, x, y = find_observed_points(capture, index)
    at, ids = mask[y, x], point_ids[points]
    found, doubts = np.unique(at[(at > 0) & (at != ids)], return_counts=True)
    # With fewer, no region of enough points is wrong.
    doubted = ClassTable(found[doubts >= _ENOUGH_POINTS * _OTHER])
    if not len(doubted):
        return
    windows = ndimage.find_objects(doubted.classes_of(mask) + 1)
    for object_id, own in zip(doubted.ids.tolist(), windows, strict=True):
        numbers, _ = ndimage.label(mask[own] == object_id)
        mine = at == object_id
        rows, columns, its = y[mine] - own[0].start, x[mine] - own[1].start, ids[mine]
        number = numbers[rows, columns]
        for each, window in enumerate(ndimage.find_objects(numbers), 1):
            inside = number == each
            if window is not None and inside.sum() >= _ENOUGH_POINTS:
                top, left = window[0].start, window[1].start
                yield Region(
                    object_id,
                    (
                        slice(own[0].start + top, own[0].start + window[0].stop),
                        slice(own[1].start + left, own[1].start + window[1].stop),
                    ),
                    numbers[window] == each,
                    columns[inside] - left,
                    rows[inside] - top,
                    its[inside],
                )
