"""The true size of a scene and what is up, where photos tell positions by GPS, or what the cameras' sensors felt."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import pycolmap

from .sources.photo_files import gps_position
from .sources.upright import up_in_camera

_FEWEST = 5
"""Number of photos with a position from which on these are used."""
_NEAREST = 5.0
"""Meters that distant cameras are apart at least, which is the precision of a phone outdoors."""
_SPREAD = 0.2
"""Largest range of the middle half of the sizes that pairs of cameras give, relative to their median."""

_FEWEST_UPRIGHT = 3
"""Number of photos that tell what is up from which on these are used."""
_TILT = 3.0
"""Largest median angle in degrees between up as these photos tell it and their common direction."""


def positions_in_meters(images: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Return where photos of a folder were taken, of those that tell: name -> (3,) meters east, north and up."""
    known = {name: place for name in names if (place := gps_position(images / name)) is not None}
    if not known:
        return {}
    places = np.array(list(known.values()))
    return dict(zip(known, pycolmap.GPSTransform().ellipsoid_to_enu(places, *places[0]), strict=True))


def meters_per_unit(centers: Mapping[str, np.ndarray], places: Mapping[str, np.ndarray]) -> float | None:
    """Return the size of a model's unit in meters, or None where GPS does not tell it.

    Of each two cameras that are farther apart than most, the distance by GPS is divided by that of the model. The
    median does not depend on single wrong positions, and the middle half of the values must agree.

    Args:
        centers: name of the photo -> (3,) center of the camera in the model.
        places: name of the photo -> (3,) where it was in meters.
    """
    both = [name for name in centers if name in places]
    if len(both) < _FEWEST:
        return None
    first, second = np.triu_indices(len(both), 1)
    here, there = (np.array([known[name] for name in both]) for known in (centers, places))
    units, meters = (np.linalg.norm(each[first] - each[second], axis=1) for each in (here, there))
    far = units > np.median(units)
    if not far.any() or float(np.median(meters[far])) < _NEAREST:
        return None
    low, middle, high = np.percentile(meters[far] / units[far], (25, 50, 75))
    return float(middle) if high - low < _SPREAD * middle else None


def ups_in_cameras(images: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Return what is up in photos of a folder, of those that tell: name -> (3,) unit vector in the camera."""
    return {name: up for name in names if (up := up_in_camera(images / name)) is not None}


def common_up(rotations: Mapping[str, np.ndarray], ups: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Return what is up in a model, or None where the photos do not tell or contradict each other.

    Args:
        rotations: name of the photo -> (3, 3) rotation from the world to the camera, with y down and z forward.
        ups: name of the photo -> (3,) unit vector in the camera.

    Returns:
        (3,) unit vector in the world.
    """
    both = [name for name in rotations if name in ups]
    if len(both) < _FEWEST_UPRIGHT:
        return None
    told = np.array([ups[name] @ rotations[name] for name in both])
    up = np.median(told, axis=0)
    length = float(np.linalg.norm(up))
    if length < 0.5:
        return None
    up /= length
    apart = np.degrees(np.arccos(np.clip(told @ up, -1.0, 1.0)))
    return up if float(np.median(apart)) < _TILT else None
