"""IDs of masks anew, where photos give an object different ones.

The regions of all photos that show the same points are one object, whatever their IDs, see `association`. Then each
object gets the ID that most of its regions have.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from ..capture import Capture
from .association import Association, Seen, associate, consistency, object_mask
from .voting import find_observed_points, find_visible_points


class Renumbered(NamedTuple):
    """Masks with new IDs.

    Attributes:
        masks: the masks (H, W) by the index of their view, as they were if they are kept.
        agreement: how often photos give a point the ID that most of them give it, in the masks as they were.
        others: the masks without a say, in the same form.
    """

    masks: dict[int, np.ndarray]
    agreement: float
    others: dict[int, np.ndarray]


class _Regions(NamedTuple):
    """The regions of a mask: their numbers (H, W), from 1, 0 for no ID; their IDs, from that of no region."""

    numbers: np.ndarray
    ids: np.ndarray


def renumber_masks(
    capture: Capture, masks: Mapping[int, np.ndarray], others: Mapping[int, np.ndarray], consistent: float
) -> Renumbered:
    """Give the regions of masks the IDs of the objects that points show there.

    A region that shows several objects is divided, and one without points keeps its ID. Points that most photos show
    without an ID belong to no object.

    Args:
        capture: the capture.
        masks: masks (H, W) by the index of their view.
        others: masks that have no say in what the objects are, in the same form; a region of theirs without points gets
            no ID, since its own may be that of another object.
        consistent: agreement from which on the masks are kept as they are.
    """
    regions = {index: _regions_of(mask) for index, mask in masks.items()}
    seen = {index: _seen(capture, index, own) for index, own in regions.items()}
    agreement = consistency([regions[index].ids[own.segments] for index, own in seen.items()], list(seen.values()))
    if agreement >= consistent:
        return Renumbered(dict(masks), agreement, dict(others))
    found = associate(list(seen.values()), len(capture.points.xyz))
    ids = _ids_of(found, list(seen.values()), list(regions.values()))
    # As one more object, whose ID is 0.
    points = np.where(_without_id(list(seen.values()), len(found.points)), len(ids), found.points)
    ids = np.append(ids, 0)
    type_of_ids = np.min_scalar_type(max(int(each.max()) for each in (ids, *(own.ids for own in regions.values()))))
    ids = ids.astype(type_of_ids)
    anew = {}
    for index, objects in zip(masks, found.objects, strict=True):
        numbers, own = regions[index]
        shown = object_mask(numbers, seen[index], _shown_most(seen[index], objects, points), points)
        anew[index] = np.where(shown > 0, ids[shown], own.astype(type_of_ids)[numbers])
    return Renumbered(anew, agreement, {index: ids[_shown(capture, index, others[index], points)] for index in others})


def _shown(capture: Capture, index: int, mask: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the object (H, W) of each pixel of a mask that has no say, by the object of each point (M,)."""
    regions = _regions_of(mask)
    photo = _seen(capture, index, regions)
    objects = _shown_most(photo, np.zeros(len(regions.ids), np.int64), points)
    return object_mask(regions.numbers, photo, objects, points)


def _regions_of(mask: np.ndarray) -> _Regions:
    ids, numbers = np.unique(np.append(mask, 0), return_inverse=True)
    # All masks are in memory, so their numbers take no more of it than they must.
    return _Regions(numbers[:-1].reshape(mask.shape).astype(np.min_scalar_type(len(ids))), ids)


def _seen(capture: Capture, index: int, regions: _Regions) -> Seen:
    observed = find_observed_points(capture, index)[0]
    points, x, y = find_visible_points(capture, np.ascontiguousarray(capture.points.xyz.T, np.float64), index, observed)
    is_certain = np.isin(points, observed)
    return Seen(points, np.stack([x, y], 1), regions.numbers[y, x].astype(np.int64), is_certain, len(regions.ids) - 1)


def _without_id(seen: list[Seen], count: int) -> np.ndarray:
    """Return which points (M,) most photos show without an ID."""
    votes = np.zeros(count)
    for photo in seen:
        votes[photo.points] += np.where(photo.segments == 0, 1, -1)
    return votes > 0


def _shown_most(photo: Seen, objects: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the object of each region (count + 1,) that most of its points belong to; as before without such points.

    Args:
        photo: the points that the photo shows.
        objects: (count + 1,) the objects of its regions.
        points: (M,) the object of each point, 0 if it is not known.
    """
    known = points[photo.points] > 0
    found = np.zeros((len(objects), int(points.max(initial=0)) + 1), np.int64)
    np.add.at(found, (photo.segments[known], points[photo.points[known]]), 1)
    most = np.where(found.any(1), found.argmax(1), objects)
    most[0] = 0
    return most


def _ids_of(found: Association, seen: list[Seen], regions: list[_Regions]) -> np.ndarray:
    """Return the ID of each object, 0 first: each ID once, so that most points keep theirs, and further objects the
    most frequent ID of their own."""
    known = np.unique(np.concatenate([own.ids for own in regions]))[1:]
    count = 1 + max(int(objects.max()) for objects in found.objects)
    points = np.zeros((count, len(known)))
    for photo, own, objects in zip(seen, regions, found.objects, strict=True):
        sizes = np.bincount(photo.segments, minlength=len(own.ids))[1:]
        np.add.at(points, (objects[1:], np.searchsorted(known, own.ids[1:])), sizes)
    ids = known[points.argmax(1)]
    objects, columns = linear_sum_assignment(-points[1:])
    ids[objects + 1] = known[columns]
    ids[0] = 0
    return ids
