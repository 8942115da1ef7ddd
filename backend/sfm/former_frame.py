"""Coordinates of an earlier model of the same photos, in which the scene of the user was set up."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from .model import SPARSE, centers_of, rotations_of

_FEWEST = 3
"""Number of photos of both models from which on one is placed as the other."""
_TURNED, _MOVED = 5.0, 0.1
"""Largest median angle in degrees between the cameras of both models, and largest median distance relative to that of
the cameras from their middle. Beyond, one of the models is wrong."""


class Pose(NamedTuple):
    """A camera's center (3,) and its rotation (3, 3) from the world to the camera."""

    center: np.ndarray
    rotation: np.ndarray


def poses_of(model: pycolmap.Reconstruction) -> dict[str, Pose]:
    """Return the poses of the cameras by name of the photo."""
    rotations = rotations_of(model)
    return {name: Pose(center, rotations[name]) for name, center in centers_of(model).items()}


def former_poses(capture: Path) -> dict[str, Pose]:
    """Return the poses of the model that a capture has; none if it has none that can be read."""
    try:
        return poses_of(pycolmap.Reconstruction(capture / SPARSE))
    except (ValueError, RuntimeError, OSError):
        return {}


def similarity(now: Mapping[str, Pose], then: Mapping[str, Pose]) -> np.ndarray | None:
    """Find the similarity transform that places cameras as they were.

    The rotation is the mean of those of the cameras, with less weight for those far from it, and scale and translation
    are medians, so that single photos whose pose was wrong do not matter.

    Args:
        now, then: the poses by name of the photo.

    Returns:
        (3, 4), scale * rotation and translation, to be applied to `now`; None if the models have too few cameras in
        common or contradict each other.
    """
    both = [name for name in now if name in then]
    if len(both) < _FEWEST:
        return None
    here, there = (np.array([poses[name].center for name in both]) for poses in (now, then))
    turns = Rotation.from_matrix([then[name].rotation.T @ now[name].rotation for name in both])
    weights = np.ones(len(both))
    for _ in range(10):
        rotation = turns.mean(weights)
        angles = np.degrees((rotation.inv() * turns).magnitude())
        weights = 1 / np.maximum(angles, 0.1)
    first, second = np.triu_indices(len(both), 1)
    apart_here, apart_there = (np.linalg.norm(each[first] - each[second], axis=1) for each in (here, there))
    if not apart_here.min() > 0:
        return None
    scale = float(np.median(apart_there / apart_here))
    turned = scale * rotation.apply(here)
    shift = np.median(there - turned, axis=0)
    reach = float(np.median(np.linalg.norm(there - np.median(there, axis=0), axis=1)))
    moved = float(np.median(np.linalg.norm(turned + shift - there, axis=1)))
    if np.median(angles) > _TURNED or not moved < _MOVED * reach:
        return None
    return np.column_stack([scale * rotation.as_matrix(), shift])
