"""The points that a training begins with: those of the capture that can be right, and more."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...capture import Capture
from ...labels import vote
from ...labels.mask_points import MaskPoints, place_points
from ...planning.coverage import unseen_points
from ...planning.plane_points import LEAST, PlanePoints, find_plane_points
from ...shared.events import Reporter
from ...shared.reconstruction.plan import Plan
from ...shared.stopping import StoppingReporter
from ...stereo.dense_points import MOST_VIEWS, find_dense_points
from ..votes import object_name

DENSE = "dense"
"""Name of the search for dense points among the parts of a command."""

_SECONDS = 0.4
"""Typical time of the search for dense points in a photo."""

PLACE = "place-points"
"""Name of the placing of points of objects that have none, among the parts of a command."""

_SECONDS_AN_OBJECT = 0.5
"""Typical time of it for an object."""


class StartingPoints(NamedTuple):
    """Points to begin with.

    Attributes:
        seeds: (M,) bool, the points of the capture that are used.
        more: further points with their objects, or None.
        plan: the plan, revised by what was found.
    """

    seeds: np.ndarray
    more: MaskPoints | None
    plan: Plan


def starting_points(
    capture: Capture,
    point_ids: np.ndarray,
    plan: Plan,
    on_planes: PlanePoints | None,
    seed: int,
    reporter: StoppingReporter,
) -> StartingPoints:
    """Choose and complete a capture's points as its plan decides.

    Args:
        capture: the capture that is trained on.
        point_ids: (M,) int64 object ID of each of its points, 0 if it belongs to none.
        plan: the plan.
        on_planes: points on planes without features, if the plan adds them; with dense points, they are found anew,
            and left out where these suffice, unless the user wants them.
        seed: of random numbers.
        reporter: receives progress, how many points are placed, and the objects that stay without any.

    Raises:
        InputError: a photo or mask cannot be read.
    """
    seeds = np.ones(len(point_ids), np.bool_) if plan.does("unseen-points") else ~unseen_points(capture, reporter.check)
    parts = []
    if plan.does("dense-points"):
        dense, seeds = _dense(capture, seeds, reporter)
        parts.append(dense)
        if on_planes is not None:
            found = find_plane_points(capture, dense.xyz, reporter.check)
            shown = f"{found.fraction:.1%} of the photos' area shows planes whose points are elsewhere"
            why = f"{shown} once dense points are added; the threshold is {LEAST:.0%}"
            plan = plan.revised("plane-points", found.fraction >= LEAST, why)
            on_planes = found if plan.does("plane-points") else None
    if on_planes is not None:
        parts.append(_voted(capture, on_planes.xyz, on_planes.rgb, reporter))
        reporter.status(f"{len(on_planes.xyz):,} points added on planes without features")
    found_ids = np.concatenate([point_ids[seeds], *(part.ids for part in parts)])
    missing = np.setdiff1d(capture.object_ids, found_ids).tolist()
    if missing:
        parts.append(_place(capture, missing, seed, reporter))
    parts = [part for part in parts if len(part.ids)]
    return StartingPoints(seeds, MaskPoints(*map(np.concatenate, zip(*parts, strict=True))) if parts else None, plan)


def _dense(capture: Capture, seeds: np.ndarray, reporter: StoppingReporter) -> tuple[MaskPoints, np.ndarray]:
    """Return points on surfaces without features, with their objects, and the seeds that do not float."""
    reporter.expect({DENSE: ("Preparing", _SECONDS * min(len(capture.train_indices), MOST_VIEWS))})
    reporter.begin(DENSE, "Finding points on surfaces without features")
    found = find_dense_points(capture, capture.train_indices, reporter.progress)
    reporter.status(
        f"{len(found.xyz):,} points added on surfaces without features; {int(found.in_front.sum()):,} of the capture's "
        "left out, which float in front of surfaces"
    )
    kept = seeds & ~found.in_front
    return _voted(capture, found.xyz, found.rgb, reporter), kept if kept.any() else seeds


def _voted(capture: Capture, xyz: np.ndarray, rgb: np.ndarray, reporter: StoppingReporter) -> MaskPoints:
    """Return points (n, 3) with the objects that masks show there."""
    ids = np.zeros(len(xyz), np.int64)
    if capture.has_masks and len(ids):
        ids = vote(capture, positions=xyz, reporter=StoppingReporter(Reporter(), reporter.stop)).ids
    return MaskPoints(xyz, rgb, ids)


def _place(capture: Capture, missing: list[int], seed: int, reporter: Reporter) -> MaskPoints:
    """Place points for the objects in the masks that have none; report how many, and the objects that stay without."""
    reporter.expect({PLACE: ("Preparing", _SECONDS_AN_OBJECT * len(missing))})
    reporter.begin(PLACE, f"Placing points of {len(missing)} object{'' if len(missing) == 1 else 's'} without any")
    placed = place_points(capture, missing, seed, reporter)
    for object_id in missing:
        count, named = int((placed.ids == object_id).sum()), object_name(capture, object_id)
        if count:
            reporter.status(
                f"object {object_id} {named}: {count:,} points where its masks agree, since COLMAP has none"
            )
        else:
            reporter.warning(f"The masks of object {object_id} ({named}) agree nowhere, so training starts without it.")
    return placed
