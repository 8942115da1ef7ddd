"""How well a model agrees with the verified matches of its photos, which tells wrong poses from right ones.

A mapper may give every photo a pose with a small reprojection error and still be wrong: each wrong photo then sees
points of its own. Its matches with the other photos, however, do not fit to the poses.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from . import database

CLOSE = 4.0
"""Largest distance in pixels of a match from its epipolar line, as for COLMAP's verification."""
AGREES = 0.6
"""Fraction of a photo's matches in pairs that fit to the poses, from which on its pose is trusted."""
_PAIR_FITS = 0.5
"""Fraction of a pair's matches that are close, from which on the pair fits."""
FEWEST_POINTS = 12
"""Number of points that a photo with a trusted pose observes at least."""


class Agreement(NamedTuple):
    """Agreement of a model with its matches.

    Attributes:
        support: name -> fraction of the photo's matches that are in pairs which fit to the poses; 1 without matches.
        trusted: names of the photos whose poses are trusted.
    """

    support: Mapping[str, float]
    trusted: frozenset[str]


def measure_agreement(model: pycolmap.Reconstruction, path: Path) -> Agreement:
    """Compare the poses of a model with the matches in the database that they were computed from.

    Each pair of posed photos has verified matches, whose angles to the epipolar planes of the poses are measured.
    """
    posed = {number: model.image(number) for number in model.reg_image_ids()}
    names = [image.name for image in posed.values()]
    fits, matches = dict.fromkeys(posed, 0), dict.fromkeys(posed, 0)
    rays: dict[int, np.ndarray] = {}
    with pycolmap.Database.open(path) as stored:
        for first, second, _, _ in database.verified_pairs(path, names):
            inliers = stored.read_two_view_geometry(first, second).inlier_matches
            cameras = [model.camera(posed[number].camera_id) for number in (first, second)]
            for number, camera in zip((first, second), cameras, strict=True):
                if number not in rays:
                    pixels = np.asarray(stored.read_keypoints(number), np.float64)[:, :2]
                    rays[number] = np.asarray(camera.cam_ray_from_img(pixels))
            errors = epipolar_errors(
                posed[first].cam_from_world().matrix(), posed[second].cam_from_world().matrix(),
                rays[first][inliers[:, 0]], rays[second][inliers[:, 1]],
            )  # fmt: skip
            close = errors * np.mean([camera.mean_focal_length() for camera in cameras]) < CLOSE
            for number in (first, second):
                matches[number] += len(inliers)
                fits[number] += len(inliers) * bool(close.mean() >= _PAIR_FITS)
    support = {
        image.name: fits[number] / matches[number] if matches[number] else 1.0 for number, image in posed.items()
    }
    trusted = frozenset(
        image.name for image in posed.values() if support[image.name] >= AGREES and image.num_points3D >= FEWEST_POINTS
    )
    return Agreement(support, trusted)


def epipolar_errors(first: np.ndarray, second: np.ndarray, at_first: np.ndarray, at_second: np.ndarray) -> np.ndarray:
    """Return the angles between the rays of matches and their epipolar planes, in radians.

    Args:
        first: world-to-camera matrix (3, 4) of the first photo.
        second: that of the second photo.
        at_first: (n, 3) unit rays in the first camera.
        at_second: those in the second one; NaN where a pixel has no ray.

    Returns:
        (n,) angles, by Sampson's approximation; infinite where rays are NaN.
    """
    rotation = second[:, :3] @ first[:, :3].T
    x, y, z = second[:, 3] - rotation @ first[:, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    normals, back = at_first @ essential.T, at_second @ essential
    residual = np.abs((at_second * normals).sum(1))
    gradient = np.sqrt((normals**2).sum(1) + (back**2).sum(1))
    errors = residual / np.maximum(gradient, 1e-12)
    return np.where(np.isfinite(errors), errors, np.inf)
