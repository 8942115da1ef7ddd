"""Which pairs of photos are matched: all of a small set, else those that a cheap comparison finds alike."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from . import database

ALL_UP_TO = 60
"""Number of photos up to which all pairs are matched."""
NEIGHBORS = 30
"""Number of most similar photos that each photo of a larger set is matched with."""
ALONG = 10
"""Number of next frames of a video that each frame is matched with."""
FEATURES = 384
"""Number of features of a photo in the cheap comparison."""
_RATIO = 0.8
"""Largest distance of a match relative to that of the second best, as in Lowe's ratio test."""


def choose_pairs(
    path: Path,
    names: Sequence[str],
    videos: Iterable[Sequence[str]] = (),
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> list[tuple[str, str]] | None:
    """Return the pairs of photos to match; None for all in the database.

    Args:
        path: the database with the features.
        names: the photos.
        videos: names of the frames of each video in the order of `names`, so that neighbors show the same.
        progress: called with the number of compared photos, and of all.

    Returns:
        Pairs of names, the smaller first in the order of `names`.
    """
    ids = database.image_ids(path)
    if len(names) <= ALL_UP_TO:
        # The database may have photos that are not used any more.
        return None if ids.keys() <= set(names) else list(combinations([name for name in names if name in ids], 2))
    names = [name for name in names if name in ids]
    features = [_unit(database.largest_features(path, ids[name], FEATURES)) for name in names]
    alike = np.zeros((len(names), len(names)), np.int32)
    for first in range(len(names)):
        progress(first, len(names))
        for second in range(first + 1, len(names)):
            alike[first, second] = alike[second, first] = count_matches(features[first], features[second])
    chosen = set()
    for first, row in enumerate(alike):
        for second in np.argsort(-row, kind="stable")[:NEIGHBORS].tolist():
            if row[second]:
                chosen.add((min(first, second), max(first, second)))
    numbers = {name: number for number, name in enumerate(names)}
    for video in videos:
        frames = [numbers[name] for name in video if name in numbers]
        for place, first in enumerate(frames):
            chosen.update((first, second) for second in frames[place + 1 : place + 1 + ALONG])
    return [(names[first], names[second]) for first, second in sorted(chosen)]


def count_matches(first: np.ndarray, second: np.ndarray) -> int:
    """Return how many unit descriptors (n, d) of a photo have a match among those (m, d) of another.

    A match passes the ratio test and is the best one in both directions.
    """
    if len(first) < 2 or len(second) < 2:
        return 0
    cosines = first @ second.T
    best = cosines.argmax(1)
    top = np.partition(cosines, -2, axis=1)[:, -2:]
    distances = np.sqrt(np.maximum(2.0 - 2.0 * top, 0.0))
    is_mutual = cosines.argmax(0)[best] == np.arange(len(first))
    return int((is_mutual & (distances[:, 1] < _RATIO * distances[:, 0])).sum())


def _unit(descriptors: np.ndarray) -> np.ndarray:
    values = descriptors.astype(np.float32)
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-6)
