"""The model that a training starts with: anchors at the capture's points, and at those that were added to them."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from ..model.anchors import cell_keys, median_spacing, seed_anchors, with_surroundings
from ..model.heads import Heads
from ..model.object_model import Normalization, ObjectModel
from ..shared.class_table import ClassTable
from .extent import pixel_size
from .settings import Settings

if TYPE_CHECKING:
    from ..capture import Capture


FINEST = 2.0
"""Edge in pixels of the finest cells that anchors grow into, where the points are farther apart."""


_FEWEST_STEPS, _SECONDS_A_PIXEL, _SECONDS_AN_ANCHOR = 500, 4e-7, 1.7e-5
"""Number of steps that a training on the CPU should have time for, and the time of a step per pixel of a view and per
anchor at the start, on a slow laptop."""

_COARSER = 1.2
"""Factor by which cells become larger until there are few enough."""

_FEWEST_ANCHORS = 10_000
"""Number of anchors that any training has time to begin with: fewer would hardly make its steps faster."""


class DistantPoints(NamedTuple):
    """Points of distant surroundings: xyz (n, 3) in world units, rgb (n, 3) uint8, distance between neighbors."""

    xyz: np.ndarray
    rgb: np.ndarray
    spacing: float


def affordable_anchors(seconds: float, capture: Capture) -> int:
    """Return the largest number of anchors that a training of limited time on the CPU should begin with.

    A model that every point adds to is of no use if there is no time for a few hundred steps. Anchors grow where they
    are missing.

    Args:
        seconds: length of the training.
        capture: the views.
    """
    pixels = float(np.mean([view.width * view.height for view in capture.views]))
    for_anchors = seconds / _FEWEST_STEPS - _SECONDS_A_PIXEL * pixels
    return max(round(for_anchors / _SECONDS_AN_ANCHOR), _FEWEST_ANCHORS)


def initial_model(
    capture: Capture,
    point_ids: np.ndarray,
    settings: Settings,
    rng: np.random.Generator,
    seeds: np.ndarray,
    more: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
    surroundings: DistantPoints | None = None,
    most_anchors: int | None = None,
) -> ObjectModel:
    """Return a model with anchors at the capture's points.

    Args:
        capture: the views and points.
        point_ids: (M,) int64 object ID of each point, 0 if it belongs to none.
        settings: settings of the training.
        rng: generator of the anchors' offsets.
        seeds: (M,) bool, the points that are used for anchors and to measure the scene's extent.
        more: xyz (n, 3), rgb (n, 3) uint8 and IDs (n,) of further points.
        surroundings: points of distant surroundings, which belong to no object.
        most_anchors: largest number of anchors without those of the surroundings, for which cells become larger; None:
            as many as there are cells with points.
    """
    xyz, rgb, ids = capture.points.xyz[seeds], capture.points.rgb[seeds], point_ids[seeds]
    camera_centers = np.array([-v.viewmat[:3, :3].T @ v.viewmat[:3, 3] for v in capture.views])
    normalization = Normalization.of(camera_centers, xyz)
    classes = ClassTable(np.concatenate([[0], point_ids, *([] if more is None else [more[2]])]))
    if more is not None:
        xyz, rgb, ids = (np.concatenate(pair) for pair in zip((xyz, rgb, ids), more, strict=True))
    finest = min(median_spacing(normalization.to_scene(xyz)), FINEST * pixel_size(capture) * normalization.scale)
    voxel = settings.voxel * normalization.scale if settings.voxel else finest
    while most_anchors is not None and _cells(normalization.to_scene(xyz), voxel) > most_anchors:
        voxel *= _COARSER
    anchors = seed_anchors(
        normalization.to_scene(xyz), rgb / 255.0, classes.classes_of(ids), voxel, settings.layout, rng
    )
    if surroundings is not None:
        anchors = with_surroundings(
            anchors, normalization.to_scene(surroundings.xyz), surroundings.rgb / 255.0, int(classes.classes_of(0)),
            normalization.scale * surroundings.spacing, rng,
        )  # fmt: skip
    if settings.mode == "paper":
        anchors.rows[:, settings.layout.color_columns] = 0
    heads = Heads(settings.layout, settings.mode, settings.sh_degree, torch.Generator().manual_seed(settings.seed))
    shade = {"learned": rgb.mean(axis=0) / 255.0, "black": np.zeros(3), "white": np.ones(3)}
    background = torch.from_numpy(shade[settings.background].astype(np.float32))
    return ObjectModel(anchors, heads, background, classes, normalization, settings.primitive)


def _cells(xyz: np.ndarray, voxel: float) -> int:
    """Return the number of cells that contain points."""
    return len(np.unique(cell_keys(xyz, voxel), axis=0))
