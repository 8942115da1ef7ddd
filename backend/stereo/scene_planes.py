"""The large planes of a scene, such as floors, walls and table tops, found among points with normals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

MOST = 8
"""Largest number of planes."""
_LEAST = 0.01
"""Smallest fraction of the points that are on a plane."""
_NEAR = 0.01
"""Largest distance of a point from its plane, relative to the distance from which it was seen."""
_ALIKE = np.cos(np.radians(20.0))
"""Least cosine of the angle between the normals of a point and of its plane."""
_REACHED = 98
"""Percentile of the distances of a plane's points from their center that is its reach."""
_LARGE, _BEYOND = 0.03, 1.3
"""Size of the smallest large plane, as a fraction of all photos' pixels; and distance from its center up to which it
goes on, relative to its reach."""
_SPREAD, _THICKEST, _ALONG = 2.0, 0.02, 0.05
"""Of planes that may be bent: standard deviations of their points within which these are on them, instead of `_NEAR`;
largest such distance; and distance from the plane within which points with its normal tell the deviation."""
_SAMPLE = 20_000
_TRIALS = 300
_ROUNDS = 3


class ScenePlane(NamedTuple):
    """A plane of a scene.

    Attributes:
        normal: (3,), unit normal n.
        offset: d; points x of the plane have n . x = d.
        center: (3,), the mean of the points that it was found from.
        reach: distance from there within which almost all of these are.
    """

    normal: np.ndarray
    offset: float
    center: np.ndarray
    reach: float


def find_planes(xyz: np.ndarray, normals: np.ndarray, distances: np.ndarray) -> list[ScenePlane]:
    """Find the planes on which most points are, by random samples of one point each (RANSAC).

    Args:
        xyz: (n, 3) points.
        normals: (n, 3) unit normals, of either sign.
        distances: (n,) distance from which each point was seen.

    Returns:
        The planes, those with most points first.
    """
    rng = np.random.default_rng(0)
    if len(xyz) > _SAMPLE:
        chosen = rng.choice(len(xyz), _SAMPLE, replace=False)
        xyz, normals, distances = xyz[chosen], normals[chosen], distances[chosen]
    fewest = _LEAST * len(xyz)
    found: list[ScenePlane] = []
    while len(found) < MOST and len(xyz) >= max(fewest, 3):
        best = np.zeros(len(xyz), np.bool_)
        for seed in rng.choice(len(xyz), min(_TRIALS, len(xyz)), replace=False):
            inside = _inside(xyz, normals, distances, normals[seed], float(normals[seed] @ xyz[seed]))
            if inside.sum() > best.sum():
                best = inside
        if best.sum() < max(fewest, 3):
            break
        for _ in range(_ROUNDS):
            middle = xyz[best].mean(0)
            normal = np.linalg.svd(xyz[best] - middle, full_matrices=False)[2][2]
            refined = _inside(xyz, normals, distances, normal, float(normal @ middle))
            if refined.sum() < 3:
                break
            best = refined
        reach = float(np.percentile(np.linalg.norm(xyz[best] - middle, axis=1), _REACHED))
        found.append(ScenePlane(normal, float(normal @ middle), middle, reach))
        # Points of a thick or slightly bent surface do not make a second plane.
        rest = ~(np.abs(xyz @ normal - normal @ middle) < 3 * _NEAR * distances)
        xyz, normals, distances = xyz[rest], normals[rest], distances[rest]
    return found


def on_plane(plane: ScenePlane, xyz: np.ndarray, normals: np.ndarray, distances: np.ndarray) -> np.ndarray:
    """Return which points (n,) bool are on a plane and not far beyond those that it was found from.

    The other arguments are those of `find_planes`.
    """
    return _inside(xyz, normals, distances, plane.normal, plane.offset) & _within_reach(plane, xyz)


def sides_of_planes(
    xyz: np.ndarray,
    normals: np.ndarray,
    distances: np.ndarray,
    seen: np.ndarray,
    pairs: tuple[np.ndarray, np.ndarray],
    may_be_bent: bool = False,
) -> np.ndarray:
    """Compare the two points of pairs with the large planes, such as the table that things stand on.

    Args:
        xyz, distances: n points, as for `find_planes`.
        normals: (n, 3) unit normals, towards the cameras.
        seen: (n,) pixels that each point covers in all photos.
        pairs: m points each.
        may_be_bent: whether the planes may be a little bent, as surfaces that are reconstructed from photos; flat
            things on them are part of them then.

    Returns:
        (m,) int8: 1 if both points are on one plane; -1 if one is on a plane and the other, with a different normal, is
        in front of it, which is where its cameras are; otherwise 0. A surface may rise smoothly from a plane, and
        behind a plane may be what it belongs to, as the sides of a box and its top.
    """
    first, second = pairs
    found, taken = np.zeros(len(first), np.int8), np.zeros(len(xyz), np.bool_)
    is_bent = (normals[first] * normals[second]).sum(1) < _ALIKE
    for plane in find_planes(xyz, normals, distances):
        off = (xyz @ plane.normal - plane.offset) / distances
        along = (np.abs(normals @ plane.normal) > _ALIKE) & _within_reach(plane, xyz)
        middle, near = _middle_and_thickness(off[along & (np.abs(off) < _ALONG)]) if may_be_bent else (0.0, _NEAR)
        on = along & (np.abs(off - middle) < near) & ~taken
        side = np.sign(normals[on].sum(0) @ plane.normal)
        # The lower side of a thing is not the plane that it lies on.
        on &= side * (normals @ plane.normal) > 0
        if seen[on].sum() < _LARGE * seen.sum():
            continue
        taken |= on
        in_front = ~on & (side * (off - middle) > 0)
        found[((on[first] & in_front[second]) | (in_front[first] & on[second])) & is_bent] = -1
        found[on[first] & on[second]] = 1
    return found


def _inside(
    xyz: np.ndarray, normals: np.ndarray, distances: np.ndarray, normal: np.ndarray, offset: float
) -> np.ndarray:
    """Return which points (n,) bool are on a plane."""
    return (np.abs(xyz @ normal - offset) < _NEAR * distances) & (np.abs(normals @ normal) > _ALIKE)


def _within_reach(plane: ScenePlane, xyz: np.ndarray) -> np.ndarray:
    """Return which points (n,) bool are not far beyond those that a plane was found from."""
    return np.linalg.norm(xyz - plane.center, axis=1) < _BEYOND * plane.reach


def _middle_and_thickness(off: np.ndarray) -> tuple[float, float]:
    """Return what a plane is off its points, and the distance from there within which points are on it, both relative
    to the distance from which they were seen, from the relative distances (m,) of points along it."""
    if len(off):
        middle = float(np.median(off))
        near = _SPREAD * 1.4826 * float(np.median(np.abs(off - middle)))
        if _NEAR < near < _THICKEST:
            return middle, near
    return 0.0, _NEAR
