"""`plan`: what a capture needs and what it can do without, in plan.json; `import`, `vote` and `train` plan, too."""

from __future__ import annotations

import argparse
from contextlib import ExitStack

import numpy as np

from .. import device
from ..capture import Capture, load_capture
from ..labels.points import read_points
from ..objects import SceneObject, edit_objects, read_objects
from ..planning.choosing import Changes, changed, chosen, grouped, read_groups
from ..planning.decisions import Choices, Look, decide
from ..planning.plan import Plan, write_plan
from ..protocol import Reconstruction, Reporter
from ..stopping import StoppingReporter
from ..training.settings import Settings
from .folder import memory_for_files, removed_if_refused
from .length import budget_of, expected_of
from .lock import locked
from .record import recorded
from .votes import object_name, votes_are_current


def plan(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Say what training would do and leave out; the folder of --out is looked at, too, and gets plan.json."""
    place, budget = device.pick(options.device), budget_of(options)
    folder = Reconstruction(options.out) if options.out else None
    with ExitStack() as held:
        if folder is not None:
            held.enter_context(removed_if_refused(folder))
            folder.create()
            held.enter_context(locked(folder.folder))
        # Pictures that were prepared already may be looked at; nothing is prepared for a plan.
        cache = folder.cache if folder is not None and folder.cameras.exists() else None
        capture = load_capture(options.capture, cache, memory_for_files(options), options.max_size, reporter)
        objects, _ = asked_objects(folder, capture, options)
        point_ids = voted_ids(folder, capture) if folder is not None else None
        found = decide(look_at(capture, choices(options), objects, point_ids))
        if folder is not None:
            write_plan(folder.plan, found)
    for decision in found.decisions:
        reporter.status(decision.sentence())
    if expected := expected_of(budget, capture, place):
        reporter.status(expected)
    reporter.done(plan=found.as_list())


def keep_plan(folder: Reconstruction, capture: Capture, max_size: int) -> None:
    """Leave the plan of a training with the usual settings in plan.json, from what is known without more work."""
    objects, _ = asked_objects(folder, capture)
    look = look_at(capture, Choices(max_size=max_size), objects, voted_ids(folder, capture))
    write_plan(folder.plan, decide(look))


def look_at(
    capture: Capture,
    asked: Choices,
    objects: list[SceneObject],
    point_ids: np.ndarray | None = None,
    thorough: bool = False,
) -> Look:
    """What decisions about a capture rest on, when objects are as the user wants them."""
    left_out = [entry.id for entry in objects if entry.left_out]
    capture = capture.edited({entry.id: entry.name for entry in objects}, left_out)
    point_ids = None if point_ids is None else capture.without_left_out(point_ids)
    return Look(capture, asked, objects, point_ids, thorough)


def choices(options: argparse.Namespace) -> Choices:
    """What `train` was asked for, as decisions take it."""
    return Choices(settings(options), options.max_size, not options.no_meshes, options.keep, options.leave_out)


def settings(options: argparse.Namespace) -> Settings:
    """The settings of a training as they were asked for."""
    given = {
        "offsets": options.offsets, "max_anchors": options.max_anchors, "voxel": options.voxel,
        "semantic_weight": options.semantic_weight, "normal_weight": options.normal_weight,
        "distortion_weight": options.distortion_weight,
    }  # fmt: skip
    return Settings(
        seed=options.seed, mode=options.mode, sh_degree=options.sh_degree, background=options.background,
        zero_is_object=options.unlabelled_is_object, primitive=options.primitive,
        **{k: v for k, v in given.items() if v is not None},
    )  # fmt: skip


def asked_objects(
    folder: Reconstruction | None, capture: Capture, options: argparse.Namespace | None = None
) -> tuple[list[SceneObject], Changes]:
    """The objects of objects.json, or before a vote those of the masks, as --groups and --only want them; and the
    changes for that, which are not made yet."""
    there = read_objects(folder.objects) if folder is not None and folder.objects.exists() else []
    there = there or [SceneObject(i, object_name(capture, i), (0, 0, 0), 0) for i in capture.object_ids.tolist()]
    path = folder.objects if folder is not None else capture.folder / "masks"
    changes: Changes = {}
    if options is not None and options.groups is not None:
        changes = grouped(there, read_groups(options.groups), options.groups)
    if options is not None and options.only:
        for object_id, change in chosen(changed(there, changes), options.only, path).items():
            changes[object_id] = {**changes.get(object_id, {}), **change}
    return changed(there, changes), changes


def change_objects(folder: Reconstruction, capture: Capture, options: argparse.Namespace) -> list[SceneObject]:
    """Make the changes that --groups and --only ask for in objects.json; returns the objects."""
    objects, changes = asked_objects(folder, capture, options)
    if changes:
        edit_objects(folder.objects, changes)
    return objects


def voted_ids(folder: Reconstruction, capture: Capture) -> np.ndarray | None:
    """The points' objects by the latest vote, whatever its strategy; None where it was on something else."""
    voted = recorded(folder).get("votes")
    if not voted or not votes_are_current(folder, capture, voted["max_size"], voted["strategy"], voted["seed"] or 0):
        return None
    return read_points(folder.points).ids


def say_plan(found: Plan, reporter: Reporter) -> None:
    """What is left out, and what is done although it was not planned."""
    for decision in found.decisions:
        if decision.done is False or decision.overridden:
            reporter.status(decision.sentence())
