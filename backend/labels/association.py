"""One ID for each object in all photos, where the segments of each photo are numbered on their own.

Segments of different photos that show the same points of the model show the same object (compare Gaga, Lyu et al.
2024). Two segments are compared on the points that both photos show: those in both of them over those in either.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage, sparse
from scipy.spatial import cKDTree

from .regions import MANY, merge_regions, mutual_matches

LEAST = 0.15
"""Smallest ratio of common points with which segments are one object; a mask that shows half of an object has 0.5,
but parts of a large object that few photos show together have less."""

FEWEST_VIEWS = 2
"""An object that fewer photos show is dropped, since nothing confirms it."""

_PART, _ENOUGH_POINTS, _NEAREST = 0.2, 5, 5
"""A segment shows another object, too, if at least this fraction of its points is on it, and this many; its pixels then
get the object that most of this many nearest points belong to."""

_BORDER = 0.01
"""Distance from a segment's border within which points may be beyond it, relative to the photo's longer side."""

_PAIRS = 1 << 17
"""Number of pairs of segments that are compared at a time."""

_NONE = np.zeros(0, np.int64)


class Seen(NamedTuple):
    """The points that one photo shows.

    Attributes:
        points: (n,) int64, distinct indices of points.
        xy: (n, 2) int64, columns and rows of their pixels.
        segments: (n,) int64, the segment at each point, from 1; 0: none.
        is_certain: (n,) bool, whether the point was found in the photo; others may be hidden.
        segment_count: number of segments of the photo.
    """

    points: np.ndarray
    xy: np.ndarray
    segments: np.ndarray
    is_certain: np.ndarray
    segment_count: int


class Association(NamedTuple):
    """The objects of the segments of V photos.

    Attributes:
        objects: for each photo, (count + 1,) int64: the object of each segment, from 1 by size; 0: none.
        points: (M,) int64, the object of each point.
        agreement: (V,) fraction of each photo's points on objects that its segments give the point's object.
    """

    objects: list[np.ndarray]
    points: np.ndarray
    agreement: np.ndarray


def associate(seen: Sequence[Seen], points: int) -> Association:
    """Find the objects that segments show.

    Args:
        seen: what each photo shows.
        points: number M of points of the model.
    """
    first = np.cumsum([0, *(photo.segment_count for photo in seen)])
    of_photo = np.repeat(np.arange(len(seen)), np.diff(first))
    inside = [photo.segments > 0 for photo in seen]
    rows = np.concatenate([first[v] + photo.segments[inside[v]] - 1 for v, photo in enumerate(seen)] or [_NONE])
    columns = np.concatenate([photo.points[inside[v]] for v, photo in enumerate(seen)] or [_NONE])
    shape = (int(first[-1]), points)
    members = sparse.coo_array((np.ones(len(rows)), (rows, columns)), shape=shape).tocsr()
    photos = np.repeat(np.arange(len(seen)), [len(photo.points) for photo in seen])
    shown = np.concatenate([photo.points for photo in seen] or [_NONE])
    visible = sparse.coo_array((np.ones(len(shown)), (photos, shown)), shape=(len(seen), points)).tocsr()
    together = (members @ members.T).tocsr()
    together.setdiag(0)
    together.eliminate_zeros()
    own = sparse.coo_array((np.ones(len(of_photo)), (np.arange(len(of_photo)), of_photo)), shape=(shape[0], len(seen)))
    cluster = _merged(together, (members @ visible.T).tocsr(), own.tocsr())
    return _settled(seen, members, cluster, of_photo, first)


def consistency(ids: Sequence[np.ndarray], seen: Sequence[Seen]) -> float:
    """Return how often photos give a point that several of them show on objects the ID that most of these give it.

    Args:
        ids: for each photo, the (n,) IDs of its points, 0 for none.
        seen: what each photo shows.
    """
    points = np.concatenate([photo.points[own > 0] for photo, own in zip(seen, ids, strict=True)] or [_NONE])
    labels = np.concatenate([own[own > 0] for own in ids] or [_NONE])
    pairs, counts = np.unique(np.stack([points, labels]), axis=1, return_counts=True)
    _, first = np.unique(pairs[0], return_index=True)
    if not len(first):
        return 1.0
    total, most = np.add.reduceat(counts, first), np.maximum.reduceat(counts, first)
    several = total > 1
    return float(most[several].sum() / total[several].sum()) if several.any() else 1.0


def _merged(together: sparse.csr_array, inside: sparse.csr_array, own: sparse.csr_array) -> np.ndarray:
    """Merge segments whose points are mostly the same, of those that the photos of both show.

    For two segments, or sets of segments, with `inside` a and b, and `own` p and q, these are a q + b p points, where
    those in both count twice. For all pairs of segments, the numbers would not fit into memory.

    Args:
        together: (S, S), the points that two segments share.
        inside: (S, V), how many points of each segment each photo shows.
        own: (S, V), 1 for the photo of each segment.

    Returns:
        (S,) the merged segment of each segment, from 0.
    """
    cluster = np.arange(len(own.indptr) - 1)
    while True:
        count = together.shape[0]
        pairs = sparse.triu(together, 1).tocoo()
        either = _in_either(inside, own, pairs.row, pairs.col) - pairs.data
        both = sparse.coo_array((either + 1j * pairs.data, (pairs.row, pairs.col)), shape=(count, count)).tocsr()
        first, second, _ = mutual_matches(both, LEAST)
        if len(first) < max(MANY * count, 1):
            break
        into = np.arange(count)
        into[second] = first
        kept, merged = np.unique(into, return_inverse=True)
        contract = sparse.coo_array((np.ones(count), (merged, np.arange(count))), shape=(len(kept), count)).tocsr()
        together = (contract @ together @ contract.T).tocsr()
        together.setdiag(0)
        together.eliminate_zeros()
        inside, own, cluster = contract @ inside, contract @ own, merged[cluster]
    # What merged segments have in common is a mean over their parts, so that the others are never merged.
    good = both.tocoo()
    left = np.unique(np.stack([good.row, good.col])[:, good.data.imag >= LEAST * good.data.real])
    together, inside, own = together[left][:, left], inside[left], own[left]
    total = (inside @ own.T).tocsr()
    total = (total + total.T - together).tocsr()
    total.setdiag(0)
    total.eliminate_zeros()
    merged = np.arange(count)
    merged[left] = count + merge_regions(together, total, LEAST)
    return np.unique(merged[cluster], return_inverse=True)[1]


def _in_either(inside: sparse.csr_array, own: sparse.csr_array, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the points (n,) in either of the sets of segments `first` and `second` (n,); see `_merged`."""
    found = np.zeros(len(first))
    for begin in range(0, len(first), _PAIRS):
        one, other = first[begin : begin + _PAIRS], second[begin : begin + _PAIRS]
        there = inside[one].multiply(own[other]) + inside[other].multiply(own[one])
        found[begin : begin + _PAIRS] = np.asarray(there.sum(1)).ravel()
    return found


def _settled(
    seen: Sequence[Seen], members: sparse.csr_array, cluster: np.ndarray, of_photo: np.ndarray, first: np.ndarray
) -> Association:
    """Give each point the object that most of its photos show, and each segment that of most of its points."""
    segments, points = members.shape
    count = int(cluster.max(initial=-1)) + 1
    belongs = sparse.coo_array((np.ones(segments), (np.arange(segments), cluster)), shape=(segments, count)).tocsr()
    votes = (members.T @ belongs).tocsr()
    of_point = _largest(votes)
    lit = np.flatnonzero(of_point >= 0)
    labels = sparse.coo_array((np.ones(len(lit)), (lit, of_point[lit])), shape=(points, count)).tocsr()
    of_segment = _largest((members @ labels).tocsr())
    photos_of = np.zeros(count, int)
    for cluster_id in range(count):
        photos_of[cluster_id] = len(np.unique(of_photo[of_segment == cluster_id]))
    sizes = np.bincount(of_point[lit], minlength=count)
    kept = [int(i) for i in np.argsort(-sizes, kind="stable") if photos_of[i] >= FEWEST_VIEWS and sizes[i]]
    number = np.zeros(count + 1, np.int64)
    number[kept] = np.arange(1, len(kept) + 1)
    ids, of_points = number[of_segment], number[of_point]
    objects = [np.concatenate([[0], ids[first[v] : first[v + 1]]]) for v in range(len(seen))]
    agreement = np.ones(len(seen))
    for v, photo in enumerate(seen):
        known = of_points[photo.points] > 0
        if known.any():
            agreement[v] = (objects[v][photo.segments[known]] == of_points[photo.points[known]]).mean()
    return Association(objects, of_points, agreement)


def _largest(counts: sparse.csr_array) -> np.ndarray:
    """Return the column of the largest entry of each row, the first of equals; -1 for rows without entries."""
    counts.sort_indices()
    rows = np.repeat(np.arange(counts.shape[0]), np.diff(counts.indptr))
    order = np.lexsort((counts.indices, -counts.data, rows))
    found = np.full(counts.shape[0], -1)
    filled = np.flatnonzero(np.diff(counts.indptr))
    found[filled] = counts.indices[order][counts.indptr[filled]]
    return found


def object_mask(segments: np.ndarray, photo: Seen, objects: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the mask of a photo, in which segments that show several objects are divided among them.

    Args:
        segments: (h, w) the segment of each pixel, from 1; 0: none.
        photo: the points that it shows.
        objects: (count + 1,) the object of each segment.
        points: (M,) the object of each point.

    Returns:
        (h, w) int64, the object of each pixel, 0 for none.
    """
    mask = objects[segments]
    of_points, boxes = points[photo.points], ndimage.find_objects(segments)
    for segment in range(1, photo.segment_count + 1):
        inside = np.flatnonzero((photo.segments == segment) & (of_points > 0) & photo.is_certain)
        if len(np.unique(of_points[inside])) < 2:
            continue
        box = boxes[segment - 1]
        shown = np.pad(segments[box] == segment, 1)
        from_border = ndimage.distance_transform_edt(shown)[1:-1, 1:-1]
        x, y = photo.xy[inside].T
        inside = inside[from_border[y - box[0].start, x - box[1].start] > _BORDER * max(segments.shape)]
        found, counts = np.unique(of_points[inside], return_counts=True)
        several = found[counts >= max(_PART * len(inside), _ENOUGH_POINTS)]
        if len(several) < 2:
            continue
        inside = inside[np.isin(of_points[inside], several)]
        rows, columns = np.nonzero(segments[box] == segment)
        rows, columns = rows + box[0].start, columns + box[1].start
        count = min(_NEAREST, len(inside))
        nearest = cKDTree(photo.xy[inside]).query(np.stack([columns, rows], 1), count)[1]
        votes = (of_points[inside][nearest][..., None] == several).sum(1)
        mask[rows, columns] = several[votes.argmax(1)]
    return mask
