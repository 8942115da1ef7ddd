# SPDX-License-Identifier: GPL-3.0-or-later
"""Simulated structure-from-motion: sparse points with tracks, from images and ground-truth depth.

Detections are sampled at textured pixels. A track continues at random in other views that see the same spot unoccluded
(tested against their depth) from a similar direction. Observations get Gaussian noise, and the points are triangulated
from them, so that the noise in space results from the noise in the images.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

NOISE = 0.5  # Standard deviation of an observation in pixels.
TOLERANCE = 0.008  # Largest depth difference in meters at which a spot counts as visible.
ANGLE = 38.0  # Largest angle in degrees between two views of a spot at which it is matched.
OUTLIERS = 0.03  # Fraction of points that are wrong matches.
TARGET = 13_500  # Wanted number of points.


@dataclass
class Cloud:
    """Sparse points with observations.

    Attributes:
        observations: for each view (xy (K, 2), point IDs (K,)).
        points: as for `files.write_colmap`.
        outlier: (P,) bool ground truth of wrong matches.
        object_id: (P,) ground-truth ID of the surface from which each point was sampled.
    """

    observations: list
    points: dict
    outlier: np.ndarray
    object_id: np.ndarray


def project(points: np.ndarray, view: Any, intrinsics: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return pixel positions (N, 2) and depths (N,) in meters of world points (N, 3) in a view."""
    local = points @ view.rotation.T + view.translation
    fx, fy, cx, cy = intrinsics
    depth = local[:, 2]
    safe = np.where(depth > 1e-6, depth, 1.0)
    return np.stack([fx * local[:, 0] / safe + cx, fy * local[:, 1] / safe + cy], 1), depth


def _lift(xy: Any, depth: Any, view: Any, intrinsics: Any) -> np.ndarray:
    fx, fy, cx, cy = intrinsics
    local = np.stack([(xy[:, 0] - cx) / fx * depth, (xy[:, 1] - cy) / fy * depth, depth], 1)
    return (local - view.translation) @ view.rotation


def _seeds(image: Any, depth: Any, count: Any, rng: Any) -> np.ndarray:
    """Sample (count, 2) pixel rows and columns in textured areas away from depth discontinuities and the sky."""
    gray = image.astype(np.float32).mean(2)
    gy, gx = np.gradient(gray)
    weight = np.hypot(gx, gy) + 1.0
    step = np.maximum(*[np.abs(g) for g in np.gradient(depth)])
    weight[(step > 0.03) | (depth <= 0)] = 0
    weight[:2], weight[-2:], weight[:, :2], weight[:, -2:] = 0, 0, 0, 0
    weight = np.minimum(weight, 40.0).ravel()
    # The Gumbel trick: weighted sampling without replacement.
    with np.errstate(divide="ignore"):
        keys = np.log(weight) + rng.gumbel(size=weight.size)
    keep = np.argpartition(-keys, count)[:count]
    keep = keep[weight[keep] > 0]
    return np.stack(np.unravel_index(keep, gray.shape), 1)


def make(views: Any, intrinsics: Any, images: Any, depths: Any, ids: Any, rng: Any, target: int = TARGET) -> Cloud:
    """Return about `target` points, fewer for few or small views.

    Args:
        views: the cameras.
        intrinsics: (fx, fy, cx, cy) in pixels.
        images: image of each view.
        depths: depth of each view in meters.
        ids: ID map of each view.
        rng: random generator.
        target: wanted number of points.
    """
    height, width = depths[0].shape
    target = min(target, len(views) * height * width // 40)
    per_view = max(1, int(np.ceil(target * 1.8 / len(views))))
    spots, source, label = [], [], []
    for v, view in enumerate(views):
        at = _seeds(images[v], depths[v], min(per_view, height * width - 1), rng)
        xy = at[:, ::-1] + 0.5
        spots.append(_lift(xy, depths[v][at[:, 0], at[:, 1]].astype(float), view, intrinsics))
        source.append(np.full(len(at), v))
        label.append(ids[v][at[:, 0], at[:, 1]])
    spots, source, label = np.concatenate(spots), np.concatenate(source), np.concatenate(label)
    seen = _seen(spots, source, label, views, intrinsics, depths, ids)
    luck = rng.random(len(spots))[:, None] * 0.5 + 0.35  # Some spots are matched more easily than others.
    seen &= rng.random(seen.shape) < luck
    seen[np.arange(len(spots)), source] = True
    cap = max(8, int(3.2 * target * 2.2 / len(views)))
    for v in range(len(views)):
        found = np.flatnonzero(seen[:, v])
        if len(found) > cap:
            seen[rng.choice(found, len(found) - cap, replace=False), v] = False
    good = np.flatnonzero(seen.sum(1) >= 3)
    if len(good) > target:
        good = np.sort(rng.choice(good, target, replace=False))
    spots, seen, label = spots[good], seen[good], label[good]
    point, view_of = np.nonzero(seen)

    outlier = rng.random(len(spots)) < OUTLIERS
    wrong = spots.copy()
    first = np.array([v.center for v in views])[seen.argmax(1)]
    along = spots - first
    shift = rng.choice([-1, 1], len(spots)) * rng.uniform(0.02, 0.15, len(spots)) / np.linalg.norm(along, axis=1)
    wrong[outlier] += (along * shift[:, None])[outlier]
    noise = np.where(outlier, 3 * NOISE, NOISE)[point, None]
    xy = np.empty((len(point), 2))
    for v, view in enumerate(views):
        rows = view_of == v
        xy[rows] = project(wrong[point[rows]], view, intrinsics)[0]
    inside = (xy > 2).all(1) & (xy < [width - 2, height - 2]).all(1)
    xy += rng.normal(size=xy.shape) * noise
    keep = inside & (np.bincount(point[inside], minlength=len(spots))[point] >= 3)
    xyz, error = _triangulate(wrong, point[keep], view_of[keep], xy[keep], views, intrinsics)
    # A real reconstruction also filters points that the observations do not constrain.
    bad = ~np.isfinite(error) | (error > 4.0) | (np.linalg.norm(xyz - wrong, axis=1) > 0.05)
    kept = np.flatnonzero(~bad & (np.bincount(point[keep], minlength=len(spots)) >= 3))
    return _pack(kept, point[keep], view_of[keep], xy[keep], xyz, error, outlier, label, views, images, rng)


def _seen(spots: Any, source: Any, label: Any, views: Any, intrinsics: Any, depths: Any, ids: Any) -> Any:
    """Return an (N, V) bool mask of the spots that each view sees."""
    height, width = depths[0].shape
    centers = np.array([v.center for v in views])
    rays = spots[:, None, :] - centers[None]
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    similar = np.einsum("nvc,nc->nv", rays, rays[np.arange(len(spots)), source]) > np.cos(np.radians(ANGLE))
    seen = np.zeros((len(spots), len(views)), bool)
    for v, view in enumerate(views):
        xy, depth = project(spots, view, intrinsics)
        inside = (depth > 0.01) & (xy > 2).all(1) & (xy < [width - 2, height - 2]).all(1)
        col, row = np.where(inside[:, None], xy, 0).astype(int).T
        seen[:, v] = inside & (np.abs(depths[v][row, col] - depth) < TOLERANCE) & (ids[v][row, col] == label)
    return seen & similar


def _triangulate(start: Any, point: Any, view_of: Any, xy: Any, views: Any, intrinsics: Any, rounds: int = 4) -> Any:
    """Return least-squares points (P, 3) from observations, and their mean reprojection errors in pixels."""
    fx, fy, cx, cy = intrinsics
    rotation = np.stack([v.rotation for v in views])[view_of]
    translation = np.stack([v.translation for v in views])[view_of]
    count = np.maximum(np.bincount(point, minlength=len(start)), 1)
    xyz = start.copy()
    for i in range(rounds + 1):
        local = np.einsum("nij,nj->ni", rotation, xyz[point]) + translation
        z = np.where(np.abs(local[:, 2]) < 1e-3, 1e-3, local[:, 2])
        rest = xy - np.stack([fx * local[:, 0] / z + cx, fy * local[:, 1] / z + cy], 1)
        if i == rounds:
            return xyz, np.bincount(point, np.linalg.norm(rest, axis=1), len(start)) / count
        flat = np.zeros((len(point), 2, 3))
        flat[:, 0, 0], flat[:, 0, 2] = fx / z, -fx * local[:, 0] / z**2
        flat[:, 1, 1], flat[:, 1, 2] = fy / z, -fy * local[:, 1] / z**2
        jacobian = flat @ rotation
        normal = np.zeros((len(start), 3, 3))
        right = np.zeros((len(start), 3))
        np.add.at(normal, point, np.swapaxes(jacobian, 1, 2) @ jacobian)
        np.add.at(right, point, np.einsum("nij,ni->nj", jacobian, rest))
        normal += 1e-6 * np.eye(3) * (1 + np.trace(normal, axis1=1, axis2=2))[:, None, None]
        xyz += np.linalg.solve(normal, right[..., None])[..., 0]
    raise AssertionError("unreachable")


def _pack(
    kept: Any,
    point: Any,
    view_of: Any,
    xy: Any,
    xyz: Any,
    error: Any,
    outlier: Any,
    label: Any,
    views: Any,
    images: Any,
    rng: Any,
) -> Cloud:
    number = np.full(len(xyz), -1)
    number[kept] = np.arange(len(kept))
    rows = number[point] >= 0
    point, view_of, xy = number[point[rows]], view_of[rows], xy[rows]
    height, width = images[0].shape[:2]
    color = np.zeros((len(kept), 3))
    slot = np.zeros(len(point), int)
    observations = []
    for v in range(len(views)):
        here = np.flatnonzero(view_of == v)
        loose = len(here) // 4  # Number of unmatched detections.
        places = np.concatenate([xy[here], rng.uniform([2, 2], [width - 2, height - 2], (loose, 2))])
        ids = np.concatenate([point[here] + 1, np.full(loose, -1)])
        order = rng.permutation(len(ids))
        observations.append((places[order], ids[order]))
        back = np.empty(len(order), int)
        back[order] = np.arange(len(order))
        slot[here] = back[: len(here)]
        col = np.clip(xy[here, 0].astype(int), 0, width - 1)
        row = np.clip(xy[here, 1].astype(int), 0, height - 1)
        np.add.at(color, point[here], images[v][row, col].astype(float))
    count = np.bincount(point, minlength=len(kept))
    rgb = np.round(color / np.maximum(count, 1)[:, None]).astype(np.uint8)
    order = np.argsort(point, kind="stable")
    pairs = np.stack([view_of + 1, slot], 1)[order]
    tracks = np.split(pairs, np.cumsum(count)[:-1]) if len(kept) else []
    points = {"xyz": xyz[kept], "rgb": rgb, "error": error[kept], "track": tracks}
    return Cloud(observations, points, outlier[kept], label[kept])
