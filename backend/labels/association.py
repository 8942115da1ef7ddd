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

from .regions import merge_regions

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
    cluster = merge_regions(together, _in_either(members, visible, together, of_photo, first), LEAST)
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


def _in_either(
    members: sparse.csr_array,
    visible: sparse.csr_array,
    together: sparse.csr_array,
    of_photo: np.ndarray,
    first: np.ndarray,
) -> sparse.csr_array:
    """Return the number of points, of those that both photos of two segments show, that are in either: (S, S)."""
    shared = (members @ visible.T).tocoo()
    counts = np.diff(first)[shared.col]
    rows = np.repeat(shared.row, counts)
    within = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    columns = np.repeat(first[shared.col], counts) + within
    values = np.repeat(shared.data, counts)
    shape = (len(of_photo),) * 2
    one_way = sparse.coo_array((values, (rows, columns)), shape=shape).tocsr()
    either = (one_way + one_way.T - together).tocsr()
    either.setdiag(0)
    either.eliminate_zeros()
    return either


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
    of_points = points[photo.points]
    for segment in range(1, photo.segment_count + 1):
        inside = np.flatnonzero((photo.segments == segment) & (of_points > 0) & photo.is_certain)
        if len(np.unique(of_points[inside])) < 2:
            continue
        shown = np.pad(segments == segment, 1)
        from_border = ndimage.distance_transform_edt(shown)[1:-1, 1:-1]
        x, y = photo.xy[inside].T
        inside = inside[from_border[y, x] > _BORDER * max(segments.shape)]
        found, counts = np.unique(of_points[inside], return_counts=True)
        several = found[counts >= max(_PART * len(inside), _ENOUGH_POINTS)]
        if len(several) < 2:
            continue
        inside = inside[np.isin(of_points[inside], several)]
        rows, columns = np.nonzero(segments == segment)
        count = min(_NEAREST, len(inside))
        nearest = cKDTree(photo.xy[inside]).query(np.stack([columns, rows], 1), count)[1]
        votes = (of_points[inside][nearest][..., None] == several).sum(1)
        mask[rows, columns] = several[votes.argmax(1)]
    return mask
