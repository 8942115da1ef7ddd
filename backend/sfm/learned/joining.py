"""Matched places of all pairs of photos as features that the pairs share, in COLMAP's database.

A network without a search for features finds other places in a photo for each pair. Places that are a pixel apart
become one feature, so that points are seen in more than two photos.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Collection
from functools import lru_cache
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial import cKDTree

from ...capture.files import read_mask
from . import positions
from .photos import LONGEST_SIDE, write_pair

MOST_FEATURES = 8192
"""Most features of a photo; those that fewer or less certain pairs show are left out."""

_REACH = 1.0
"""Largest distance of a place from its feature, in pixels of the scaled photo."""
_KEPT = 64
"""Number of photos whose features are kept in memory while pairs are verified."""


def join_pairs(
    path: Path,
    matched: Path,
    names: Collection[str],
    masks: Path | None,
    verification: pycolmap.TwoViewGeometryOptions,
) -> None:
    """Write features and verified matches of all matched pairs to a database, unless they are there.

    If features change, by pairs that were matched since, all are replaced at once, and all pairs are verified again.

    Args:
        path: the database, with the photos.
        matched: the file of matched places, as of `positions.opened`.
        names: the photos; pairs of others are left out.
        masks: folder with NAME.png for each photo, black where there shall be no features; or None.
        verification: how matches are verified.

    Raises:
        InputError: A mask cannot be read.
    """
    with positions.opened(matched) as found, pycolmap.Database.open(path) as stored:
        photos = {image.name: image for image in stored.read_all_images() if image.name in names}
        _write_features(stored, found, photos, masks)
        _write_pairs(stored, found, photos, verification)


def shared_features(places: np.ndarray, scale: float) -> np.ndarray:
    """Return the features of a photo that stand for all places in it which pairs show in common.

    Features are at least two pixels of the scaled photo apart, in x or in y. Pixels are taken by the sum of their
    certainties: those that many pairs show first.

    Args:
        places: (n, 3), x and y in pixels of the photo, not negative, and the certainty.
        scale: size of the scaled photo relative to the photo.

    Returns:
        (k, 2) float32, k <= `MOST_FEATURES`, in pixels of the photo.
    """
    if not len(places):
        return np.zeros((0, 2), np.float32)
    pixels, owners = np.unique((places[:, :2] * scale).astype(int), axis=0, return_inverse=True)
    votes = np.bincount(owners, places[:, 2])
    means = np.column_stack([np.bincount(owners, places[:, 2] * places[:, axis]) / votes for axis in (0, 1)])
    near_others = np.zeros(pixels.max(0) + 3, bool)
    chosen: list[int] = []
    for number in np.argsort(-votes, kind="stable").tolist():
        x, y = pixels[number]
        if not near_others[x + 1, y + 1]:
            chosen.append(number)
            near_others[x : x + 3, y : y + 3] = True
    return means[chosen[:MOST_FEATURES]].astype(np.float32)


def _write_features(
    stored: pycolmap.Database, found: sqlite3.Connection, photos: dict[str, pycolmap.Image], masks: Path | None
) -> None:
    """Write the features of all photos, and remove all matches, unless these features are there."""
    features = {}
    for name, image in photos.items():
        camera = stored.read_camera(image.camera_id)
        size = np.array([camera.width, camera.height])
        places = positions.of_photo(found, name)
        places = places[((places[:, :2] >= 0) & (places[:, :2] < size)).all(1)]
        if masks is not None:
            mask = read_mask(masks / f"{name}.png") > 0
            columns, rows = (places[:, :2] * np.divide(mask.shape[::-1], size)).astype(int).T
            places = places[mask[rows, columns]]
        features[image.image_id] = shared_features(places, _scale_of(camera))
    if all(
        stored.exists_keypoints(number) and np.array_equal(stored.read_keypoints(number), points)
        for number, points in features.items()
    ):
        return
    with pycolmap.DatabaseTransaction(stored):
        stored.clear_two_view_geometries()
        stored.clear_matches()
        stored.clear_keypoints()
        for number, points in features.items():
            stored.write_keypoints(number, points)


def _write_pairs(
    stored: pycolmap.Database,
    found: sqlite3.Connection,
    photos: dict[str, pycolmap.Image],
    verification: pycolmap.TwoViewGeometryOptions,
) -> None:
    """Write the matches of all pairs, as indices of features, and verify them, unless they are there."""

    @lru_cache(_KEPT)
    def features(name: str) -> tuple[np.ndarray, cKDTree, float]:
        image = photos[name]
        points = np.asarray(stored.read_keypoints(image.image_id), np.float32).reshape(-1, 2)
        return points, cKDTree(points), _REACH / _scale_of(stored.read_camera(image.camera_id))

    for pair in positions.listed(found):
        if not photos.keys() >= set(pair):
            continue
        first, second = (photos[name] for name in pair)
        if stored.exists_two_view_geometry(first.image_id, second.image_id):
            continue
        places = positions.of_pair(found, *pair)
        points, indices = [], []
        for number, name in enumerate(pair):
            own, tree, reach = features(name)
            points.append(own)
            indices.append(tree.query(places[:, 2 * number : 2 * number + 2], distance_upper_bound=reach)[1])
        known = np.column_stack([each < len(own) for each, own in zip(indices, points, strict=True)]).all(1)
        matches = _one_to_one(np.column_stack(indices)[known])
        if first.image_id > second.image_id:
            first, second, points, matches = second, first, points[::-1], matches[:, ::-1]
        write_pair(stored, (first, second), (points[0], points[1]), matches, verification)


def _one_to_one(matches: np.ndarray) -> np.ndarray:
    """Return matches (m, 2) without those of which an earlier one has a feature."""
    for column in (0, 1):
        matches = matches[np.sort(np.unique(matches[:, column], return_index=True)[1])]
    return matches


def _scale_of(camera: pycolmap.Camera) -> float:
    """Return the size of a camera's scaled photos relative to its photos."""
    return min(1.0, LONGEST_SIDE / max(camera.width, camera.height))
