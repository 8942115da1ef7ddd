"""What the commands that plan have in common: the facts for the decisions, plan.json, and the requested objects."""

from __future__ import annotations

import argparse

from ..capture import Capture
from ..planning.decisions import Choices, PlanningContext, decide
from ..shared.events import Reporter
from ..shared.formats.points_ply import LabeledPoints, read_points
from ..shared.grouping import Changes, changed, chosen, grouped, read_groups
from ..shared.reconstruction.folder import Reconstruction
from ..shared.reconstruction.objects import SceneObject, edit_objects, read_objects
from ..shared.reconstruction.plan import Plan, write_plan
from ..shared.reconstruction.record import read_record
from ..training.settings import Settings
from .length import budget_of
from .votes import object_name, votes_are_current

_CLEARLY = 0.8
"""Margin from which on a point without an object counts as background: 9 of 10 masks leave it unlabeled."""


def write_default_plan(folder: Reconstruction, capture: Capture, max_size: int, reporter: Reporter) -> Plan:
    """Write plan.json for a training with the default settings, from the facts known so far, and return it."""
    objects, _ = find_requested_objects(folder, capture)
    points, wanted = voted_points(folder, capture), Choices(max_size=max_size)
    context = build_context(capture, wanted, objects, reporter, points)
    plan = decide(context)
    write_plan(folder.plan, plan)
    return plan


def build_context(
    capture: Capture,
    requested: Choices,
    objects: list[SceneObject],
    reporter: Reporter,
    points: LabeledPoints | None = None,
    thorough: bool = False,
    resumed: Plan | None = None,
) -> PlanningContext:
    """Collect the facts for the decisions.

    Args:
        capture: The capture, unedited.
        requested, objects, thorough, resumed: As in `PlanningContext`.
        reporter: Ends the planning if the user wants to stop.
        points: The result of a vote on the capture's points; None before.

    Returns:
        The context, with the user's edits of the objects.
    """
    left_out = [entry.id for entry in objects if entry.left_out]
    capture = capture.edited({entry.id: entry.name for entry in objects}, left_out)
    if points is None:
        return PlanningContext(capture, requested, objects, thorough=thorough, resumed=resumed, check=reporter.check)
    ids = capture.without_left_out(points.ids)
    # Points at the borders of objects, which some masks show on them, are not evidence of a background.
    in_background = (ids == 0) & ((points.margins >= _CLEARLY) | (points.ids != 0))
    return PlanningContext(
        capture, requested, objects, ids, in_background, thorough, resumed=resumed, check=reporter.check
    )


def choices(options: argparse.Namespace) -> Choices:
    """Return the choices that the options of `train` make."""
    until_converged = budget_of(options).until_converged
    return Choices(
        settings(options), options.max_size, not options.no_meshes, options.keep, options.leave_out, until_converged
    )


def settings(options: argparse.Namespace) -> Settings:
    """Return the settings that the options of `train` make, before the plan changes them."""
    given = {
        "offsets": options.offsets, "max_anchors": options.max_anchors, "voxel": options.voxel,
        "semantic_weight": options.semantic_weight, "normal_weight": options.normal_weight,
        "distortion_weight": options.distortion_weight,
    }  # fmt: skip
    return Settings(
        seed=options.seed, mode=options.mode, sh_degree=options.sh_degree, background=options.background,
        zero_is_object=options.unlabeled_is_object, primitive=options.primitive,
        **{k: v for k, v in given.items() if v is not None},
    )  # fmt: skip


def find_requested_objects(
    folder: Reconstruction | None, capture: Capture, options: argparse.Namespace | None = None
) -> tuple[list[SceneObject], Changes]:
    """Find the objects as --groups and --only change them, without writing the changes.

    Args:
        folder: The reconstruction with objects.json; None if there is none.
        capture: Its masks give the objects before a vote.
        options: The options of `train`; None for no changes.

    Returns:
        The changed objects, and the changes for `edit_objects`.

    Raises:
        InputError: An option names an object that does not exist.
    """
    known = read_objects(folder.objects) if folder is not None and folder.objects.exists() else []
    known = known or [SceneObject(i, object_name(capture, i), (0, 0, 0), 0) for i in capture.object_ids.tolist()]
    path = folder.objects if folder is not None else capture.folder / "masks"
    changes: Changes = {}
    if options is not None and options.groups is not None:
        changes = grouped(known, read_groups(options.groups), options.groups)
    if options is not None and options.only:
        for object_id, change in chosen(changed(known, changes), options.only, path).items():
            changes[object_id] = {**changes.get(object_id, {}), **change}
    return changed(known, changes), changes


def change_objects(folder: Reconstruction, capture: Capture, options: argparse.Namespace) -> list[SceneObject]:
    """Apply --groups and --only to objects.json and return the objects."""
    objects, changes = find_requested_objects(folder, capture, options)
    if changes:
        edit_objects(folder.objects, changes)
    return objects


def voted_points(folder: Reconstruction, capture: Capture) -> LabeledPoints | None:
    """Return the points from the latest vote with any strategy; None if it is not current."""
    voted = read_record(folder).votes
    if not voted or not votes_are_current(folder, capture, voted.max_size, voted.strategy, voted.seed or 0):
        return None
    return read_points(folder.points)


def report_plan(found: Plan, reporter: Reporter) -> None:
    """Report the decisions to omit something, and the decisions that the user overrode."""
    for decision in found.decisions:
        if decision.done is False or decision.overridden:
            reporter.status(decision.sentence())
