"""Repair of masks by all photos together: regions that the other photos contradict.

The objects of the splats are voted on by the masks of all training views, each pixel for the splats that it shows. A
region of a mask whose ID most of its pixels do not get from these votes is wrong: it no longer votes, and so on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from scipy import ndimage

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
        masks: the mask (H, W) int64 of each training view by its index.
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
        given: the masks (H, W) of training views by index, with an object at least.
        zero_is_known: whether unlabeled pixels are known to show no object; otherwise, they count less, since they may
            be gaps.
        progress: receives the number of masks that have voted, and of all in all votes.
    """
    objects = np.unique([0, *(value for mask in given.values() for value in np.unique(mask).tolist())])
    wrong = {index: np.zeros(mask.shape, bool) for index, mask in given.items()}
    for number in range(_ROUNDS):
        voting = {index: np.where(wrong[index], _NO_VOTE, mask) for index, mask in given.items()}

        def tell(done: int, before: int = number * len(given)) -> None:
            progress(before + done, _ROUNDS * len(given))

        votes = pointer.votes(voting, objects, tell)
        if not zero_is_known:
            votes[:, 0] *= _GAPS
        ids = pointer.settle(objects, votes)
        before = wrong
        wrong = {index: contradicted(given[index], shown) for index, shown in pointer.shown_ids(ids, list(given))}
        if all(np.array_equal(before[index], wrong[index]) for index in given):
            break
    masks = {
        index: np.where(wrong[index], shown, given[index]) if index in given else shown
        for index, shown in pointer.masks(ids)
    }
    return Repair(ids, masks)


def contradicted(mask: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Return the pixels (H, W) bool of regions of a mask whose pixels mostly show another object.

    Args:
        mask: (H, W) IDs; a region is connected and has one ID.
        shown: (H, W) IDs.
    """
    found = np.zeros(mask.shape, bool)
    for value in np.unique(mask):
        regions, count = ndimage.label(mask == value)
        agrees = ndimage.mean(shown == value, regions, np.arange(count + 1))
        is_large = np.bincount(regions.ravel(), minlength=count + 1) >= _SMALLEST * mask.size
        found |= ((agrees < _AGREES) & is_large)[regions] & (regions > 0)
    return found
