"""`train`: begins, resumes or extends a training; leaves a checkpoint, previews, splats.ply and anchors.ply."""

from __future__ import annotations

import argparse
import shutil
from typing import Any

import numpy as np
import torch

from .. import device
from ..capture import Capture
from ..evaluation import IdScores, comparison, curve_picture, psnr, save_picture, thumbnail
from ..export import agreement, fit_splats, write_anchors, write_splats
from ..labels.points import read_points
from ..model.checkpoint import has_checkpoint
from ..model.object_model import ObjectModel
from ..planning.coverage import unseen_points
from ..planning.decisions import OF_TRAINING, decide, planned_capture, planned_settings
from ..planning.plan import Plan, write_plan
from ..protocol import Cancelled, InputError, Reconstruction, Reporter, plain
from ..raster.draw import draw
from ..stopping import StoppingReporter
from ..training.budget import Budget, Progress
from ..training.loop import Evaluate, Trainer
from ..training.scene import Scene
from .folder import described, digest, memory_for_planes, open_reconstruction, plan_of
from .kernels import have_kernels_ready
from .length import budget_of, expected_of
from .plan import asked_objects, change_objects, choices, look_at, say_plan, settings
from .record import record, record_stage, recorded, stage
from .votes import cast_votes, votes_are_current, votes_key

CURVE_VIEWS = 20
"""So many held-out views at most are measured while training; `evaluate` measures all."""

_COMPARED_VIEWS = 20
"""On so many views at most the exported splats are compared with the model."""


def train(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Train, resume or extend; leaves a checkpoint, previews, splats.ply and anchors.ply."""
    place = device.pick(options.device)
    budget = budget_of(options)
    with open_reconstruction(options, reporter) as (folder, capture):
        trainer, plan = _begun(folder, capture, options, reporter, place)
        progress = trainer.progress
        if progress.step and budget.share(progress) >= 1:
            reporter.status(
                f"Already trained for {progress.step} steps in {progress.seconds:.0f} s; ask for more --minutes or "
                "--steps to extend it, or --restart to begin anew."
            )
        else:
            record(
                folder,
                capture=described(capture, options.max_size),
                training={
                    "settings": trainer.settings.as_dict(),
                    "minutes": None if budget.seconds is None else budget.seconds / 60,
                    "steps": budget.steps,
                    "preset": options.preset,
                    "device": device.name_of(place),
                    "left_out": trainer.scene.capture.left_out.tolist(),
                    "votes": votes_key(trainer.scene.capture, options.max_size, options.strategy, options.seed),
                    "plan": plan.as_list(),
                },
            )
            if expected := expected_of(budget, trainer.scene.capture, place, progress):
                reporter.status(expected)
            try:
                _run(trainer, budget, folder, options.checkpoint_seconds, reporter)
            except Cancelled:
                # What a stopped training has come to is there to be seen too, where that takes no time.
                if trainer.model.explicit and progress.step:
                    _export(trainer.shown, trainer.scene, folder, reporter)
                raise
        export = _export(trainer.shown, trainer.scene, folder, reporter)
    latest = progress.curve[-1] if progress.curve else {}
    reporter.done(
        steps=progress.step, seconds=round(progress.seconds, 1), anchors=len(trainer.model.anchors),
        splats=str(folder.splats), psnr=latest.get("psnr"), miou=latest.get("miou"),
        psnr_of_export=export["psnr_of_export"],
    )  # fmt: skip


def _begun(
    folder: Reconstruction,
    capture: Capture,
    options: argparse.Namespace,
    reporter: StoppingReporter,
    place: torch.device,
) -> tuple[Trainer, Plan]:
    """The training to go on with, or a new one, after a vote where the one that is there would differ; and its plan."""
    resuming = not options.restart and has_checkpoint(folder.checkpoint)
    voters = capture.without_masks() if "votes" in options.leave_out else capture
    current = votes_are_current(folder, voters, options.max_size, options.strategy, options.seed)
    if not (current or resuming):
        cast_votes(folder, voters, options, reporter)
    point_ids = read_points(folder.points).ids if current or not resuming else None
    objects, _ = asked_objects(folder, capture, options)
    look = look_at(capture, choices(options), objects, point_ids, thorough=True)
    plan = decide(look)
    if resuming:
        plan = plan.settled_by(_plan_before(folder))
    gains = look.gains if plan.does("exposure") else np.ones_like(look.gains)
    planned, wanted = planned_capture(look.capture, plan), planned_settings(settings(options), plan)
    memory = memory_for_planes(options)
    if resuming:
        resumed = Trainer.resume(planned, folder.checkpoint, wanted, memory, place, gains)
        assert resumed is not None
        trainer, warning = resumed
        if warning:
            reporter.warning(warning)
        _refuse_another(folder, planned, plan, options)
    else:
        assert look.point_ids is not None
        seeds = None if plan.does("unseen-points") else ~unseen_points(planned)
        trainer = Trainer.start(
            planned, look.point_ids, wanted, memory, place,
            seeds=seeds, teach_unlabelled=planned.has_masks and plan.does("rest"), gains=gains,
        )  # fmt: skip
    if options.restart:
        shutil.rmtree(folder.checkpoint, ignore_errors=True)
    change_objects(folder, voters, options)
    write_plan(folder.plan, plan)
    say_plan(plan, reporter)
    return trainer, plan


def _plan_before(folder: Reconstruction) -> Plan:
    """What was planned for the training that DIR holds."""
    return plan_of(recorded(folder).get("training", {}))


def _refuse_another(folder: Reconstruction, capture: Capture, plan: Plan, options: argparse.Namespace) -> None:
    """InputError where DIR holds the training of another capture, or of other choices."""
    memory = recorded(folder)
    otherwise = "use the same, another --out, or --restart to train anew."
    if "training" not in memory:
        raise InputError(f"{folder.settings} does not say what {folder.checkpoint} was trained from; {otherwise}")
    training = memory["training"]
    votes = training["votes"]
    if votes["capture"] != digest(capture):
        raise InputError(f"{folder.checkpoint} was trained on another capture than {capture.folder}; {otherwise}")
    if votes["max_size"] != options.max_size:
        raise InputError(f"{folder.checkpoint} was trained with --max-size {votes['max_size']}; {otherwise}")
    if votes["strategy"] != options.strategy:
        raise InputError(f"{folder.checkpoint} was trained with --strategy {votes['strategy']}; {otherwise}")
    before, left_out = training.get("left_out", []), capture.left_out.tolist()
    if before != left_out:
        without = f"without {', '.join(map(str, before))}" if before else "with all objects"
        raise InputError(
            f"{folder.checkpoint} was trained {without}, and {folder.objects} leaves out "
            f"{', '.join(map(str, left_out)) or 'none'}; leave out the same, or use --restart to train anew."
        )
    if "plan" in training and (otherwise_now := plan.difference(plan_of(training), OF_TRAINING)):
        raise InputError(
            f"{folder.checkpoint} was trained by another plan ({', '.join(otherwise_now)}); --keep and --leave-out the "
            f"same, or use --restart to train anew."
        )


def _run(
    trainer: Trainer, budget: Budget, folder: Reconstruction, checkpoint_seconds: float, reporter: StoppingReporter
) -> None:
    """Train. The loop heeds a stop by itself, since it has a checkpoint to write first."""
    have_kernels_ready(reporter, trainer.model.device)
    folder.previews.mkdir(exist_ok=True)
    step = trainer.progress.step
    begun = f"Going on after step {step} with" if step else "Training"
    where = "" if trainer.model.device.type == "cpu" else f", on {device.name_of(trainer.model.device)}"
    reporter.status(f"{begun} {len(trainer.model.anchors):,} anchors{where}")
    measure = _held_out(folder, reporter)
    try:
        trainer.run(budget, folder.checkpoint, reporter.reporter, measure, reporter.stop, checkpoint_seconds)
    except Cancelled:
        record_stage(folder, "train", trainer.progress.seconds)
        raise
    record_stage(folder, "train", trainer.progress.seconds)


def _held_out(folder: Reconstruction, reporter: StoppingReporter) -> Evaluate:
    """Figures of the held-out views for the curve, a preview of the first of them, and one of the curve."""

    def measure(model: ObjectModel, scene: Scene, progress: Progress) -> dict[str, Any]:
        # Without SSIM, which would take most of the time: the clock of the training runs meanwhile.
        found, ids = [], IdScores(scene.zero_is_object)
        capture = scene.capture
        every = max(len(capture.test_indices) // CURVE_VIEWS, 1)
        for place, index in enumerate(capture.test_indices[::every][:CURVE_VIEWS] or (0,)):
            photo, truth = capture.image(index), capture.mask(index)
            picture = draw(model, scene.camera(index), want_ids=truth is not None or place == 0)
            if place == 0:
                assert picture.ids is not None
                preview = comparison(photo, picture.image, truth, picture.ids, None, capture.names)
                render = save_picture(thumbnail(picture.image), folder.previews / "render.png", quick=True)
                latest = save_picture(preview, folder.previews / "latest.png", quick=True)
                reporter.preview(latest, render=render)
            if capture.test_indices:
                found.append(psnr(picture.image, photo))
                if truth is not None and picture.ids is not None:
                    ids.add(picture.ids, truth)
        scores = ids.result()
        figures = {
            "psnr": float(np.mean(found)) if found else None, "miou": scores["miou"], "mbiou": scores["mbiou"],
        }  # fmt: skip
        curve = curve_picture([*progress.curve, {"seconds": progress.seconds, **figures}])
        if curve is not None:
            save_picture(curve, folder.previews / "curve.png", quick=True)
        return figures

    return measure


def _export(model: ObjectModel, scene: Scene, folder: Reconstruction, reporter: Reporter) -> dict[str, Any]:
    """Write splats.ply and anchors.ply; returns, and records, how many they hold and, where the splats are only a fit,
    their PSNR to the model."""
    with stage(folder, "export"):
        export = _write_export(model, scene, folder, reporter)
    record(folder, export=export)
    return export


def _write_export(model: ObjectModel, scene: Scene, folder: Reconstruction, reporter: Reporter) -> dict[str, Any]:
    reporter.status(f"Writing {folder.splats.name}")
    psnr = None
    capture = scene.capture
    if model.explicit:
        splats, source = model.splats()
    else:
        splats, source = fit_splats(model, [scene.camera(i) for i in capture.train_indices], reporter)
    if not model.explicit or model.primitive == "2d":
        views = (capture.test_indices or capture.train_indices)[:_COMPARED_VIEWS]
        psnr = plain(agreement(model, splats, [scene.camera(i) for i in views]))
        where = "held-out" if capture.test_indices else "training"
        how_well = "cannot be measured" if psnr is None else f"is {psnr:.1f} dB"
        what, has = (
            ("A view-dependent model has no exact splats", "a fit")
            if not model.explicit
            else ("Most programs know no flat splats", "thin Gaussians instead")
        )
        say = reporter.status if model.explicit else reporter.warning
        say(
            f"{what}: {folder.splats.name} holds {has}, whose PSNR to the model's own pictures of the {where} views "
            f"{how_well}."
        )
    for sentence in write_splats(folder.splats, splats):
        reporter.warning(sentence)
    write_anchors(folder.anchors, model, splats, source)
    return {
        "splats": len(splats),
        "anchors": len(model.anchors),
        "psnr_of_export": None if psnr is None else round(psnr, 2),
    }
