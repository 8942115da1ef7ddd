"""`train`: begin, resume or extend a training, and write a checkpoint, previews, splats.ply and anchors.ply."""

from __future__ import annotations

import argparse
import functools
import statistics
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from ...capture import Capture
from ...labels import correct_masks
from ...model.checkpoint import has_checkpoint
from ...planning.agreement import measure_agreement
from ...planning.decisions import OF_TRAINING, decide, planned_capture, planned_settings
from ...raster import devices
from ...shared.durations import Limit
from ...shared.errors import Cancelled, InputError
from ...shared.events import Reporter
from ...shared.expectation import DEFAULT_SECONDS, is_far_fewer
from ...shared.formats.points_ply import read_points
from ...shared.reconstruction.checkpoint import PREVIOUS
from ...shared.reconstruction.folder import Reconstruction
from ...shared.reconstruction.plan import Plan, write_plan
from ...shared.reconstruction.record import TrainingRecord, read_record, update_record
from ...shared.stopping import StoppingReporter
from ...training.budget import Budget, TrainingProgress
from ...training.initial_model import FEWEST_ANCHORS, DistantPoints, affordable_anchors, measure_detail
from ...training.processes.team import Order, Team, choose_gpu, connect, is_follower, processes, processes_here
from ...training.trainer import Trainer
from ..exported import EXPORT, export_model
from ..folder import (
    READ,
    capture_record,
    digest,
    memory_for_targets,
    open_reconstruction,
    outdate_results,
    plan_of,
    recorded_agreement,
)
from ..length import budget_of, expected_of, expected_psnr_of, expected_steps_of, training_seconds
from ..planning import build_context, change_objects, choices, find_requested_objects, report_plan, settings
from ..setup.device import choose_device
from ..setup.kernels import PART as KERNELS
from ..setup.kernels import ensure_kernels, kernel_seconds
from ..setup.machine import threads_of_all_processes
from ..stages import finish_stage
from ..votes import VOTE, cast_votes, votes_are_current, votes_key
from .follow import follow
from .measuring import Measuring
from .memory import warn_of_memory
from .points import DENSE, PLACE, starting_points

PACE = "pace"
"""Name of the measurement of a step's time among the parts of a command."""

_TIMED_VIEWS, _SHORTEST_STEP = 3, 1e-4
"""Number of views on which the time of a step is measured, and its least seconds, as of one without anchors in view."""


def train(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Begin, resume or extend a training, and write a checkpoint, previews, splats.ply and anchors.ply."""
    if options.device != "cpu":
        choose_gpu()
    options.memory_mb /= processes_here()
    if is_follower():
        follow(options)
        return
    device = choose_device(options.device, reporter)
    team = connect(device)
    with team.leading():
        _train(team, options, device, reporter)


def _train(team: Team, options: argparse.Namespace, device: torch.device, reporter: StoppingReporter) -> None:
    budget = budget_of(options)
    reporter.expect(
        {
            READ: ("Preparing", 5.0), VOTE: ("Preparing", 5.0), "plan": ("Preparing", 5.0),
            DENSE: ("Preparing", 0.0), PLACE: ("Preparing", 0.0), KERNELS: ("Preparing", kernel_seconds(device)),
            PACE: ("Preparing", 0.0),
            "train": ("Training", Limit(budget.seconds) if budget.seconds else DEFAULT_SECONDS),
            EXPORT: ("Saving", 5.0),
        }
    )  # fmt: skip
    _check_not_imported(Reconstruction(options.out), options)
    expected_steps = None
    with open_reconstruction(options, reporter) as (output, capture):
        folder = output.folder
        _expect_training(budget, capture, device, TrainingProgress(), reporter)
        trainer, plan = _begin(folder, capture, options, budget, reporter, device)
        output.accept()
        progress = trainer.progress
        budget.begin(progress)
        if progress.step and budget.progress(progress) >= 1:
            reporter.status(
                f"Already trained for {progress.step} steps in {progress.seconds:.0f} s; specify more --minutes or "
                "--steps to extend it, or --restart to start over."
            )
        else:
            agreement = recorded_agreement(folder, capture, options.max_size)
            if agreement is None:
                agreement = measure_agreement(trainer.scene.capture, reporter.check)
            expected_steps = expected_steps_of(budget, trainer.scene.capture, device, progress)
            update_record(
                folder,
                capture=capture_record(capture, options.max_size, agreement),
                training=TrainingRecord(
                    settings=trainer.settings.as_dict(),
                    minutes=None if budget.seconds is None else budget.seconds / 60,
                    steps=budget.steps,
                    preset=options.preset,
                    device=devices.name_of(device),
                    left_out=trainer.scene.capture.left_out.tolist(),
                    votes=votes_key(trainer.scene.capture, options.max_size, options.strategy, options.seed),
                    plan=plan.as_list(),
                    expected_psnr=expected_psnr_of(budget, trainer.scene.capture, device, progress, agreement),
                    expected_steps=expected_steps,
                ),
            )
            _expect_training(budget, trainer.scene.capture, device, progress, reporter)
            if expected := expected_of(budget, trainer.scene.capture, device, progress, agreement):
                reporter.status(expected)
            warn_of_memory(trainer, options.memory_mb, reporter)
            try:
                _run(trainer, team, budget, folder, options.checkpoint_seconds, reporter)
            except Cancelled:
                # Also export the result of a stopped training if this takes no time.
                if trainer.model.explicit and progress.step:
                    export_model(trainer.shown, trainer.scene, folder, reporter, compare=False)
                raise
        model, scene = trainer.shown, trainer.scene
        # The moments of the optimizer, and the model that is not shown, take more memory than the export.
        del trainer
        export = export_model(model, scene, folder, reporter)
    if is_far_fewer(progress.step, expected_steps):
        reporter.warning(
            f"Only {progress.step:,} of the {expected_steps:,} or more steps that were expected in "
            f"{(budget.seconds or 0) / 60:g} minutes were done, perhaps since other programs use the processors; run "
            "the same command with more --minutes to go on."
        )
    latest = progress.latest
    reporter.done(
        steps=progress.step, seconds=round(progress.seconds, 1), anchors=len(model.anchors),
        splats=str(folder.splats), psnr=latest.get("psnr"), miou=latest.get("miou"), miou_all=latest.get("miou_all"),
        zero_is_background=scene.supervise_background,
        psnr_of_export=export.psnr_of_export,
    )  # fmt: skip


def _expect_training(
    budget: Budget, capture: Capture, device: torch.device, done: TrainingProgress, reporter: Reporter
) -> None:
    """Tell the reporter how long the training takes, of which `done` is done."""
    reporter.expect({"train": ("Training", training_seconds(budget, capture, device, done))})


def _begin(
    folder: Reconstruction,
    capture: Capture,
    options: argparse.Namespace,
    budget: Budget,
    reporter: StoppingReporter,
    device: torch.device,
) -> tuple[Trainer, Plan]:
    """Resume the folder's training or start one, with a new vote if necessary; return the trainer and the plan."""
    resuming = not options.restart and has_checkpoint(folder.checkpoint)
    voters, before = capture.without_masks() if "votes" in options.leave_out else capture, None
    if resuming:
        _check_same_capture(folder, capture, options)
        before = plan_of(read_record(folder).training)
        voters = _without_new_masks(voters, before, reporter)
    if not votes_are_current(folder, voters, options.max_size, options.strategy, options.seed):
        cast_votes(folder, voters, options, reporter)
    reporter.begin("plan", "Planning the training")
    points = read_points(folder.points)
    objects, _ = find_requested_objects(folder, capture, options)
    context = build_context(capture, choices(options), objects, reporter, points, thorough=True, resumed=before)
    assert context.point_ids is not None
    plan = decide(context)
    if before is not None:
        plan = plan.settled_by(before)
    gains = context.gains if plan.does("exposure") else np.ones_like(context.gains)
    planned, wanted = planned_capture(context.capture, plan), planned_settings(settings(options), plan)
    if not planned.train_indices:
        raise InputError(
            f"The plan leaves no photo of {capture.folder} to train on; add photos, or keep with --keep those that it "
            "leaves out."
        )
    if planned.has_masks:
        supervised = plan.does("rest") and not options.unlabeled_is_object
        planned, regions = correct_masks(planned, points.ids, supervised, reporter.check)
        if regions:
            reporter.status(f"{regions} regions of masks contradict those of other views and are corrected")
    memory = memory_for_targets(options)
    if resuming:
        resumed = Trainer.resume(planned, folder.checkpoint, wanted, memory, device, gains)
        assert resumed is not None
        trainer, warning = resumed
        if warning:
            reporter.warning(warning)
        _check_same_plan(folder, planned, plan)
        if unknown := sorted({*context.point_ids.tolist()} - {0, *trainer.model.classes.ids.tolist()}):
            reporter.warning(
                f"The masks show objects that this training does not have ({', '.join(map(str, unknown))}); use "
                "--restart to train them."
            )
    else:
        far = DistantPoints(*context.surroundings[:3]) if plan.does("surroundings") else None
        on_planes = context.plane_points if plan.does("plane-points") else None
        seeds, more, plan = starting_points(planned, context.point_ids, plan, on_planes, options.seed, reporter)
        # Once for both trainers that may be started.
        detail = measure_detail(planned, seeds, more, reporter.check)
        start = functools.partial(
            Trainer.start, planned, context.point_ids, wanted, memory, device, seeds=seeds,
            supervise_background=planned.has_masks and plan.does("rest"), gains=gains, more=more, surroundings=far,
            detail=detail, check=reporter.check,
        )  # fmt: skip
        trainer = start()
        if not budget.until_converged and device.type == "cpu" and wanted.mode != "paper" and wanted.voxel is None:
            trainer = _affordable(trainer, start, 0 if far is None else len(far.xyz), budget, reporter)
    if options.restart:
        # The new training's first checkpoint replaces that of the old one before anything refers to it.
        trainer.save(folder.checkpoint)
        (folder.checkpoint / PREVIOUS).unlink(missing_ok=True)
        options.restart = False  # The same command would discard it.
    if not resuming:
        outdate_results(folder)
    change_objects(folder, voters, options)
    write_plan(folder.plan, plan)
    report_plan(plan, reporter)
    return trainer, plan


def _affordable(
    trainer: Trainer,
    start: Callable[..., Trainer],
    distant: int,
    budget: Budget,
    reporter: StoppingReporter,
) -> Trainer:
    """Return a trainer that begins with as many anchors as its time allows: `trainer`, or a new one.

    Args:
        trainer: a trainer that begins with all anchors.
        start: starts one with `most_anchors`, besides those in the distance.
        distant: number of anchors in the distance.
        budget: length of the training.
        reporter: receives progress and a message.
    """
    views, anchors = trainer.scene.capture.train_indices, len(trainer.model.anchors) - distant
    if budget.seconds is None or anchors <= FEWEST_ANCHORS:
        return trainer
    ensure_kernels(reporter, trainer.model.device)
    reporter.begin(PACE, "Measuring the time of a step")
    seconds = []
    for index in views[:: max(len(views) // _TIMED_VIEWS, 1)][:_TIMED_VIEWS]:
        seconds.append(trainer.view_step.measure_seconds(index))
        reporter.progress(len(seconds), _TIMED_VIEWS)
    steps = budget.seconds / max(statistics.median(seconds), _SHORTEST_STEP) * processes()
    most = affordable_anchors(anchors, steps, len(views))
    if most == anchors:
        return trainer
    reporter.status(
        f"The time is enough for about {steps:,.0f} steps with {anchors:,} anchors, so the training begins with about "
        f"{most:,} of them for more steps; more grow where they are missing"
    )
    return start(most_anchors=most)


def _check_not_imported(folder: Reconstruction, options: argparse.Namespace) -> None:
    """Raise InputError if a training would replace imported splats without being asked to."""
    record = read_record(folder)
    if record.imported is not None and record.training is None and folder.splats.exists() and not options.restart:
        raise InputError(
            f"{folder.splats} was imported from {record.imported.file}, and the training would replace it; use "
            "--restart for that, or another --out."
        )


def _check_same_capture(folder: Reconstruction, capture: Capture, options: argparse.Namespace) -> None:
    """Raise InputError if the folder has a training of another capture, or of images of another size."""
    training = read_record(folder).training
    otherwise = "use the same one, a different --out, or --restart to start over."
    if training is None:
        raise InputError(f"{folder.settings} has no record of the training in {folder.checkpoint}; {otherwise}")
    votes = training.votes
    if votes.capture != digest(capture):
        raise InputError(
            f"{folder.checkpoint} was trained on another capture than {capture.folder}, or with other held-out views; "
            f"{otherwise}"
        )
    if votes.max_size != options.max_size:
        raise InputError(f"{folder.checkpoint} was trained with --max-size {votes.max_size}; {otherwise}")
    if votes.strategy != options.strategy:
        raise InputError(f"{folder.checkpoint} was trained with --strategy {votes.strategy}; {otherwise}")


def _without_new_masks(capture: Capture, before: Plan, reporter: Reporter) -> Capture:
    """Return the capture without its masks if it had none when the training with the plan `before` was begun."""
    votes = before["votes"]
    if not capture.has_masks or votes is None or votes.planned is not False:
        return capture
    reporter.warning(
        f"The masks in {capture.folder / 'masks'} are not used, since the training was begun without masks; "
        "`clean-labels` gives its splats their objects, and --restart trains with them."
    )
    return capture.without_masks()


def _check_same_plan(folder: Reconstruction, capture: Capture, plan: Plan) -> None:
    """Raise InputError if the folder has a training without the same objects, or with another plan."""
    training = read_record(folder).training
    assert training is not None
    before, left_out = training.left_out, capture.left_out.tolist()
    if before != left_out:
        without = f"without {', '.join(map(str, before))}" if before else "with all objects"
        raise InputError(
            f"{folder.checkpoint} was trained {without}, and {folder.objects} leaves out "
            f"{', '.join(map(str, left_out)) or 'none'}; leave out the same objects, or use --restart to start over."
        )
    if training.plan is not None and (otherwise_now := plan.difference(plan_of(training), OF_TRAINING)):
        raise InputError(
            f"{folder.checkpoint} was trained with another plan ({', '.join(otherwise_now)}); use the same --keep and "
            "--leave-out, or --restart to start over."
        )


def _run(
    trainer: Trainer,
    team: Team,
    budget: Budget,
    folder: Reconstruction,
    checkpoint_seconds: float,
    reporter: StoppingReporter,
) -> None:
    """Run the training, which handles a stop itself, since it writes a checkpoint first."""
    ensure_kernels(reporter, trainer.model.device)
    if team.size > 1:
        trainer.save(folder.checkpoint)
        team.tell(Order.OPEN)
        trainer.work_with(team)
    folder.previews.mkdir(exist_ok=True)
    step = trainer.progress.step
    begun = f"Resuming after step {step} with" if step else "Training"
    where = "" if trainer.model.device.type == "cpu" else f", on {devices.name_of(trainer.model.device)}"
    where += f", in {team.size} processes" if team.size > 1 else ""
    reporter.begin("train", f"{begun} {len(trainer.model.anchors):,} anchors{where}")

    def check() -> None:
        # A pause begins after the evaluation, when the training has been saved.
        if reporter.stop.stopped:
            raise Cancelled

    measure = Measuring(folder, budget, reporter, check)

    def evaluate(*state: Any) -> dict[str, Any]:
        # The other processes wait.
        with threads_of_all_processes():
            return measure(*state)

    try:
        trainer.run(budget, folder.checkpoint, reporter.reporter, evaluate, reporter.stop, checkpoint_seconds)
    except Cancelled:
        finish_stage(folder, "train", trainer.progress.seconds)
        raise
    finish_stage(folder, "train", trainer.progress.seconds)
