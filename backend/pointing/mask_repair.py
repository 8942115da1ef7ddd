"""Repair of masks by all photos together: regions that the other photos contradict.

The objects of the splats are voted on by the masks of all training views, each pixel for the splats that it shows. A
region of a mask whose ID most of its pixels do not get from these votes is wrong: it no longer votes, and so on.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from skimage.measure import label

from .pointer import Pointer

_ROUNDS = 3
"""Largest number of votes; the errors that are left after the third are rarely found by a fourth."""

_AGREES = 0.5
"""Fraction of a region's pixels that must show its object."""

_SMALLEST = 5e-4
"""Size of regions that are judged, relative to the image: smaller ones may be finer than the splats."""

_GAPS = 0.75
"""Weight of the votes of unlabeled pixels that may be gaps: with half of the pixels in gaps, objects still win."""

_NO_VOTE = -1


class Repair(NamedTuple):
    """Repaired masks.

    Attributes:
        ids: (N,) int64, the object of each splat.
        masks: the mask (H, W) of each training view by its index, of the smallest unsigned type for all IDs.
    """

    ids: np.ndarray
    masks: dict[int, np.ndarray]


def repair_masks(
    pointer: Pointer, given: Mapping[int, np.ndarray], zero_is_known: bool, progress: Callable[[int, int], object]
) -> Repair:
    """Find the object of each splat by masks, and repair the masks by what the splats then show.

    Unlabeled pixels vote, too: gaps that other masks do not have are contradicted as wrong IDs are.

    Args:
        pointer: the splats.
        given: the masks (H, W) of training views by index, of any type of integers, with an object at least.
        zero_is_known: whether unlabeled pixels are known to show no object; otherwise, they count less, since they may
            be gaps.
        progress: receives the number of finished steps, and that of all rounds, the later of which may be left out.
    """
    objects = np.unique([0, *(value for mask in given.values() for value in np.unique(mask).tolist())])
    type_of_ids = np.min_scalar_type(objects[-1])
    type_of_votes = np.promote_types(type_of_ids, np.int8)
    masks = {index: pointer.voting_mask(index, mask.astype(type_of_ids)) for index, mask in given.items()}
    wrong = {index: np.zeros(mask.shape, bool) for index, mask in masks.items()}
    done, steps = itertools.count(1), (1 + _ROUNDS) * len(masks)

    def tell(*_: object) -> None:
        progress(min(next(done), steps), steps)

    # All masks vote in the first round; in later ones, only what has become wrong or right since.
    votes = pointer.votes(masks, objects, tell)
    for number in range(1, _ROUNDS + 1):
        weighted = votes if zero_is_known else votes * np.where(objects == 0, _GAPS, 1.0)
        ids = pointer.settle(objects, weighted)
        before, wrong = wrong, {}
        for index, shown in pointer.shown_ids(ids, list(masks)):
            wrong[index] = contradicted(masks[index], shown)
            tell()
        changed = [index for index in masks if not np.array_equal(before[index], wrong[index])]
        if number == _ROUNDS or not changed:
            break
        for sign, then, now in ((-1, before, wrong), (1, wrong, before)):
            voting = {i: np.where(now[i] & ~then[i], masks[i].astype(type_of_votes), _NO_VOTE) for i in changed}
            votes += sign * pointer.votes(voting, objects, tell)
        # Less than nothing is left by rounding only.
        np.maximum(votes, 0, out=votes)
    repaired = {}
    for index, shown in pointer.masks(ids):
        mask = shown.astype(type_of_ids)
        if index in given:
            mask = np.where(contradicted(given[index], mask), mask, given[index].astype(type_of_ids))
        repaired[index] = mask
    return Repair(ids, repaired)


def contradicted(mask: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Return the pixels (H, W) bool of regions of a mask whose pixels mostly show another object.

    Args:
        mask: (H, W) IDs; a region is connected and has one ID.
        shown: (H, W) IDs.
    """
    regions = label(mask, background=-1, connectivity=1)
    sizes = np.bincount(regions.ravel())
    agree = np.bincount(regions.ravel(), weights=(mask == shown).ravel())
    return ((agree < _AGREES * sizes) & (sizes >= _SMALLEST * mask.size))[regions]
