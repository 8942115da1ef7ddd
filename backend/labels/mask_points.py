"""Points for objects that no point of the capture belongs to, placed where the object's masks agree.

COLMAP finds no points on objects without texture. Since new anchors keep the ID of their parent (ObjectGS section 3.2),
an object without points could never appear. Its masks bound it, though: where the rays through the pixels of one mask
enter the space that the other masks agree on (the visual hull, Laurentini 1994), points of the object are placed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..capture import Capture
from ..shared.stopping import Check, proceed

MOST_POINTS = 400
"""Largest number of points for an object."""

_VIEWS, _PIXELS, _DEPTHS = 12, 100, 96
"""Largest number of views that rays start from, of rays in a view, and number of depths tried along a ray."""

_AGREEMENT = 0.8
"""Smallest fraction of the views that show the object, and the position, whose masks have to agree on a position."""

_NEARER, _FARTHER = 0.5, 1.5
"""Range of the depths along a ray, relative to those of the capture's points in the view."""


class MaskPoints(NamedTuple):
    """Points placed for objects: xyz (M, 3) float64 in world units, rgb (M, 3) uint8, ids (M,) int64."""

    xyz: np.ndarray
    rgb: np.ndarray
    ids: np.ndarray


def place_points(capture: Capture, object_ids: Sequence[int], seed: int = 0, check: Check = proceed) -> MaskPoints:
    """Place points of objects where their masks in the training views agree.

    Args:
        capture: The capture; must be prepared.
        object_ids: The objects.
        seed: For the choice of pixels and points.
        check: Called at intervals; ends the work by an exception once the user wants to stop.

    Returns:
        Up to MOST_POINTS points for each object; none for an object whose masks agree nowhere or that fewer than two
        views show.
    """
    parts = []
    for object_id in object_ids:
        check()
        parts.append(_points_of(capture, object_id, np.random.default_rng([seed, object_id])))
    found = [(xyz, rgb, np.full(len(xyz), i, np.int64)) for (xyz, rgb), i in zip(parts, object_ids, strict=True)]
    nothing = (np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, np.int64))
    return MaskPoints(*(np.concatenate(columns) for columns in zip(nothing, *found, strict=True)))


def _points_of(capture: Capture, object_id: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions (M, 3) and colors (M, 3) of the points of one object."""
    shown_in = [index for index in capture.train_indices if object_id in capture.ids_in(index)]
    masks = {index: mask == object_id for index in shown_in if (mask := capture.mask(index)) is not None}
    if len(masks) < 2:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    chosen = np.unique(np.linspace(0, len(masks) - 1, min(len(masks), _VIEWS)).astype(int))
    positions, colors = [], []
    for index in np.array(list(masks))[chosen].tolist():
        rays, seen = _rays(capture, index, masks[index], rng)
        agreed = _agreement(capture, masks, rays.reshape(-1, 3)).reshape(rays.shape[:2]) >= _AGREEMENT
        hit = agreed.any(1)
        positions.append(rays[hit, agreed[hit].argmax(1)])
        colors.append(seen[hit])
    xyz, rgb = np.concatenate(positions), np.concatenate(colors)
    keep = np.sort(rng.permutation(len(xyz))[:MOST_POINTS])
    return xyz[keep], rgb[keep]


def _rays(capture: Capture, index: int, mask: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return positions along the rays of pixels of a mask, (n, _DEPTHS, 3), near to far, and the pixels' colors."""
    view = capture.views[index]
    rotation, translation = view.viewmat[:3, :3], view.viewmat[:3, 3]
    depths = capture.points.xyz @ rotation[2] + translation[2]
    near, far = np.percentile(depths[depths > 0], [1, 99]) if (depths > 0).any() else (0.1, 10.0)
    rows, columns = np.nonzero(mask)
    picked = rng.permutation(len(rows))[:_PIXELS]
    rows, columns = rows[picked], columns[picked]
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], 1)
    directions = pixels @ np.linalg.inv(view.K).T
    along = np.geomspace(_NEARER * near, _FARTHER * far, _DEPTHS)
    in_camera = directions[:, None] * along[:, None]
    return (in_camera - translation) @ rotation, capture.image(index)[rows, columns]


def _agreement(capture: Capture, masks: dict[int, np.ndarray], xyz: np.ndarray) -> np.ndarray:
    """Return the fraction (n,) of the views with the positions (n, 3) inside whose masks show the object there.

    Where fewer than two views have a position inside, it is 0.
    """
    inside, agreeing = np.zeros(len(xyz), np.int64), np.zeros(len(xyz), np.int64)
    for index, mask in masks.items():
        view = capture.views[index]
        in_camera = xyz @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            x = in_camera[:, 0] / in_camera[:, 2] * view.K[0, 0] + view.K[0, 2]
            y = in_camera[:, 1] / in_camera[:, 2] * view.K[1, 1] + view.K[1, 2]
            shown = (in_camera[:, 2] > 0) & (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height)
        inside += shown
        agreeing[shown] += mask[y[shown].astype(np.int64), x[shown].astype(np.int64)]
    return np.where(inside >= 2, agreeing / np.maximum(inside, 1), 0.0)
