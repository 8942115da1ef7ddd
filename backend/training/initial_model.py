"""The model that a training starts with: anchors at the capture's points, and at those that were added to them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from ..model.anchors import Anchors, cell_keys, median_spacing, seed_anchors, with_surroundings
from ..model.heads import Heads
from ..model.object_model import Normalization, ObjectModel
from ..shared.class_table import ClassTable
from ..shared.stopping import Check, proceed
from .extent import pixel_size
from .settings import Settings

if TYPE_CHECKING:
    from ..capture import Capture


FINEST = 2.0
"""Edge in pixels of the finest cells that anchors grow into, where the points are farther apart."""


_PASSES, FEWEST_ANCHORS = 8, 15_000
"""How often a training shows each view at least, if it begins with fewer anchors for that, but not with fewer than the
second number."""

_COARSER = 1.1
"""Least factor by which cells grow until few enough points are left, one in each."""


class DistantPoints(NamedTuple):
    """Points of distant surroundings: xyz (n, 3) in world units, rgb (n, 3) uint8, distance between neighbors."""

    xyz: np.ndarray
    rgb: np.ndarray
    spacing: float


class Detail(NamedTuple):
    """How finely photos and points show a scene.

    pixel: side of a pixel at the points that it shows, in world units. spacing: distance between neighboring points, in
    scene units.
    """

    pixel: float
    spacing: float


def affordable_anchors(anchors: int, steps: float, views: int) -> int:
    """Return the number of anchors that a training of limited time should begin with.

    A model in which each point has an anchor is of no use if there is no time to show each view several times. More
    anchors grow where they are missing.

    Args:
        anchors: number of anchors if all points are used.
        steps: number of steps that there is time for with all of them.
        views: number of views to train on.
    """
    return min(anchors, max(round(anchors * steps / (_PASSES * views)), FEWEST_ANCHORS))


def initial_model(
    capture: Capture,
    point_ids: np.ndarray,
    settings: Settings,
    rng: np.random.Generator,
    seeds: np.ndarray,
    more: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
    surroundings: DistantPoints | None = None,
    most_anchors: int | None = None,
    detail: Detail | None = None,
    check: Check = proceed,
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
        most_anchors: largest number of anchors without those of the surroundings, for which points are left out; None:
            that of the settings.
        detail: result of `measure_detail` for the same points, if it is known.
        check: called at intervals; ends the work by an exception once the user wants to stop.
    """
    normalization = _normalization(capture, seeds)
    xyz, rgb, ids = capture.points.xyz[seeds], capture.points.rgb[seeds], point_ids[seeds]
    classes = ClassTable(np.concatenate([[0], point_ids, *([] if more is None else [more[2]])]))
    if more is not None:
        xyz, rgb, ids = (np.concatenate(pair) for pair in zip((xyz, rgb, ids), more, strict=True))
    detail = detail or measure_detail(capture, seeds, more, check)
    finest = min(detail.spacing, FINEST * detail.pixel * normalization.scale)
    voxel = settings.voxel * normalization.scale if settings.voxel else finest
    most = settings.max_anchors if most_anchors is None else min(most_anchors, settings.max_anchors)
    if most_anchors is not None or _occupied(normalization.to_scene(xyz), voxel) > most:
        kept = _thinned(normalization.to_scene(xyz), ids, voxel, most, check)
        xyz, rgb, ids = xyz[kept], rgb[kept], ids[kept]
    anchors = seed_anchors(
        normalization.to_scene(xyz), rgb / 255.0, classes.classes_of(ids), voxel, settings.layout, rng
    )
    _widen(anchors, detail.pixel * normalization.scale)
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


def measure_detail(
    capture: Capture,
    seeds: np.ndarray,
    more: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
    check: Check = proceed,
) -> Detail:
    """Measure the size of pixels and the distance between points; arguments as in `initial_model`."""
    pixel = pixel_size(capture, check)
    xyz = capture.points.xyz[seeds] if more is None else np.concatenate([capture.points.xyz[seeds], more[0]])
    return Detail(pixel, median_spacing(_normalization(capture, seeds).to_scene(xyz)))


def _normalization(capture: Capture, seeds: np.ndarray) -> Normalization:
    """Return the transform to scene units, in which the used points have a fixed extent."""
    camera_centers = np.array([-v.viewmat[:3, :3].T @ v.viewmat[:3, 3] for v in capture.views])
    return Normalization.of(camera_centers, capture.points.xyz[seeds])


def _widen(anchors: Anchors, pixel: float) -> None:
    """Add (pixel / 2)^2 to the variance of the splats, half as wide as the extents of their scales, if it is known.

    Splats narrower than a pixel would leave gaps at first, through which the surface is learned too late or not at all.
    """
    if math.isfinite(pixel):
        extents = anchors.rows[:, anchors.layout.scale_columns]
        extents.copy_(torch.logaddexp(2.0 * extents, torch.tensor(2.0 * math.log(pixel))) / 2.0)


def _occupied(xyz: np.ndarray, voxel: float) -> int:
    """Return the number of voxels with points xyz (M, 3)."""
    return len(_first_of_each(cell_keys(xyz, voxel)))


def _first_of_each(rows: np.ndarray) -> np.ndarray:
    """Return the index of the first of each of the distinct rows (n, m), in the order of these.

    As `np.unique` does, which takes three times as long for rows.
    """
    order = np.lexsort(rows.T[::-1])
    ordered = rows[order]
    return order[np.append(True, (ordered[1:] != ordered[:-1]).any(1))]


def _thinned(xyz: np.ndarray, ids: np.ndarray, voxel: float, most: int, check: Check) -> np.ndarray:
    """Return the indices of points that give about `most` anchors, evenly spread, with some of each object.

    At most one point of an object is kept in each cell, of a size at which there are few enough.
    """
    edge, most = voxel, max(most, len(np.unique(ids)))
    while True:
        check()
        kept = _first_of_each(np.column_stack([cell_keys(xyz, edge), ids]))
        if len(kept) <= most:
            return kept
        # Their number falls with the cube of the edge at most.
        edge *= max(_COARSER, float(np.cbrt(len(kept) / most)))
