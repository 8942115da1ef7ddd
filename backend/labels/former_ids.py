"""IDs of objects that are found anew: those that earlier masks gave them, so that edits stay with their objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from .association import Association, Seen

_SAME = 0.5
"""Intersection over union, counted in points, above which two objects are the same; no object can be it twice."""
_OTHER = 0.1
"""Intersection over union, counted in pixels, below which two objects of one ID are different ones."""


def keep_ids(
    found: Association, seen: Sequence[Seen], former: Mapping[int, np.ndarray], first_free: int
) -> Association:
    """Give objects the IDs that they have in earlier masks.

    Args:
        found: the objects of V photos, numbered from 1.
        seen: what each of the V photos shows.
        former: by index of a photo, the (n,) IDs of its points in the earlier masks, 0 for none.
        first_free: the smallest ID that no earlier object has had; objects that are new get IDs from it on.

    Returns:
        The same objects with other IDs.
    """
    pairs = [
        np.stack([found.objects[index][seen[index].segments], np.asarray(ids, np.int64)])
        for index, ids in former.items()
    ]
    now, then = np.concatenate(pairs or [np.zeros((2, 0), np.int64)], axis=1)
    count = 1 + max((int(objects.max(initial=0)) for objects in found.objects), default=0)
    known, columns = np.unique(np.append(then, 0), return_inverse=True)
    both = np.zeros((count, len(known)))
    np.add.at(both, (now, columns[:-1]), 1)
    either = both.sum(1, keepdims=True) + both.sum(0) - both
    same = both > _SAME * either
    same[0], same[:, 0] = False, False
    is_known = same.any(1)
    ids = np.where(is_known, known[same.argmax(1)], 0)
    is_new = ~is_known
    is_new[0] = False
    ids[is_new] = first_free + np.arange(is_new.sum())
    return found._replace(objects=[ids[objects] for objects in found.objects], points=ids[found.points])


def ids_of_others(now: np.ndarray, then: np.ndarray) -> list[int]:
    """Return the IDs that stand for other objects in new masks than in earlier ones.

    Args:
        now, then: (n,) int64, the IDs of the same pixels in the new and in the earlier masks, 0 for none.

    Returns:
        The IDs, ascending; those that only one of the masks has are not among them.
    """
    ids, columns = np.unique(np.concatenate([now, then]), return_inverse=True)
    new, old = columns.reshape(2, -1)
    both, ours, theirs = (np.bincount(each, minlength=len(ids)) for each in (new[new == old], new, old))
    other = (ids > 0) & (ours > 0) & (theirs > 0) & (both < _OTHER * (ours + theirs - both))
    return [int(object_id) for object_id in ids[other]]
