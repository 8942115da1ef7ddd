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

    def has(self, xyz: np.ndarray, normals: np.ndarray, distances: np.ndarray) -> np.ndarray:
        """Return which points (n,) bool are on the plane; the arguments are those of `find_planes`."""
        return _inside(xyz, normals, distances, self.normal, self.offset)


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


def _inside(
    xyz: np.ndarray, normals: np.ndarray, distances: np.ndarray, normal: np.ndarray, offset: float
) -> np.ndarray:
    """Return which points (n,) bool are on a plane."""
    return (np.abs(xyz @ normal - offset) < _NEAR * distances) & (np.abs(normals @ normal) > _ALIKE)
