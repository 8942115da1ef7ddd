"""Photos of a turntable: what is around the objects stands still, and says that the camera does, too."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pycolmap

from . import database

_STILL = 1.5
"""Largest distance in pixels between the two places of a match that does not move."""
_MOST = 0.5
"""Fraction of a pair's matches that do not move, and of the pairs, above which the background stands still."""


def stands_still(path: Path, names: Iterable[str]) -> bool:
    """Return whether most matches of most pairs of photos are at the same place in both.

    Photos by a moving camera have none: at most a tenth of the matches of one pair in a hundred.

    Args:
        path: the database with the verified matches.
        names: the photos.
    """
    pairs = database.verified_pairs(path, names)
    still = 0
    places: dict[int, np.ndarray] = {}
    with pycolmap.Database.open(path) as stored:
        for first, second, _, _ in pairs:
            for number in (first, second):
                if number not in places:
                    places[number] = np.asarray(stored.read_keypoints(number))[:, :2]
            inliers = stored.read_two_view_geometry(first, second).inlier_matches
            moved = np.linalg.norm(places[first][inliers[:, 0]] - places[second][inliers[:, 1]], axis=1)
            still += bool((moved < _STILL).mean() > _MOST)
    return still > _MOST * len(pairs)
