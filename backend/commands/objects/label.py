"""`label`: strokes on objects become masks of the capture, and the trained splats get the objects' IDs."""

from __future__ import annotations

import argparse
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ...capture import Capture, load_capture
from ...capture.made_masks import OVERVIEW, new_masks, write_mask
from ...evaluation.images import MaskSheet
from ...model.splats import Splats
from ...planning.decisions import Choices, decide, planned_capture, planned_settings
from ...pointing.pointer import Pointer
from ...pointing.strokes import Strokes, read_strokes
from ...shared.errors import Cancelled, InputError
from ...shared.events import Reporter
from ...shared.formats.json_file import read_json, write_json
from ...shared.formats.points_ply import read_points
from ...shared.reconstruction.checkpoint import PREVIOUS
from ...shared.reconstruction.folder import STROKES, Reconstruction
from ...shared.reconstruction.objects import default_name, forget_vanished
from ...shared.reconstruction.plan import write_plan
from ...shared.reconstruction.record import TrainingRecord, update_record
from ...shared.stopping import StoppingReporter
from ...training.fine_tuning.relabel import begin_with_labels, budget_of_labels
from ...training.settings import Settings
from ...training.trainer import Trainer
from ..exported import EXPORT, export_model
from ..folder import (
    READ,
    Trained,
    locked_reconstruction,
    memory_for_files,
    memory_for_targets,
    outdate_results,
    plan_of,
)
from ..imported import write_labeled
from ..planning import build_context, find_requested_objects
from ..setup.kernels import PART as KERNELS
from ..setup.kernels import ensure_kernels, kernel_seconds
from ..stages import finish_stage, stage
from ..votes import cast_votes, votes_key
from .pointable import GRAPH, Pointable, open_pointable, require_splats, segmentation

_MASKS, _TRAIN = "masks", "train"
_OWNER = "reconstruction"
"""Entry of the strokes beside the masks that are made of them: the folder of the reconstruction."""
_UNTRAINED = {GRAPH: ("Preparing", 5.0), EXPORT: ("Saving", 5.0)}
"""Parts of the command for splats without a training."""


def label(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Find the objects from the strokes, write masks/ and labels.json of the capture, and train their IDs."""
    reporter.expect(
        {
            READ: ("Preparing", 5.0), KERNELS: ("Preparing", 0.0), GRAPH: ("Preparing", 5.0),
            _MASKS: ("Making masks", 5.0), _TRAIN: ("Training", 25.0), EXPORT: ("Saving", 5.0),
        }
    )  # fmt: skip
    with locked_reconstruction(options):
        opened = open_pointable(options, reporter)
        source = require_splats(opened)
        if isinstance(source, Splats):
            _label_plain(opened, source, options, reporter)
        else:
            _label_trained(opened, source, options, reporter)


def _label_trained(
    opened: Pointable, trained: Trained, options: argparse.Namespace, reporter: StoppingReporter
) -> None:
    """Find the objects, write masks of the photos, and train the objects' borders."""
    capture, device = trained.capture, opened.device
    _require_own_masks(capture)
    strokes = read_strokes(options.strokes, opened.views.names)
    segment = segmentation(options, device)
    if (other := _other_owner(capture, trained.folder)) is not None:
        reporter.warning(
            f"{capture.folder / 'masks'} has the masks of another reconstruction's strokes, that in {other}, and is "
            "replaced; to go on with the other one, separate its objects again."
        )
    reporter.expect({KERNELS: ("Preparing", kernel_seconds(device)), _TRAIN: ("Training", border_seconds(trained))})
    ensure_kernels(reporter, device)
    forget_vanished(trained.folder.objects)
    reporter.begin(GRAPH, "Comparing the splats with their neighbors")
    with stage(trained.folder, "label"):
        pointer = opened.pointer(reporter.progress, segment)
        ids = _solve(pointer, strokes, reporter)
        reporter.begin(_MASKS, f"Making masks of {len(capture.train_indices)} photos")
        _write_masks(trained, pointer, ids, strokes, options, reporter)
    del pointer, segment  # The training needs their memory.
    trainer = begin_border_training(trained, opened.splats.source.cpu().numpy(), ids, options, reporter)
    train_borders(trained, trainer, reporter)
    reporter.done(
        masks=str(capture.folder / "masks"), objects=_number_of(strokes), views=len(capture.train_indices),
        splats=str(trained.folder.splats), steps=trainer.progress.step,
        picture=str(capture.folder / "masks" / OVERVIEW),
    )  # fmt: skip


def _label_plain(opened: Pointable, splats: Splats, options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Find the objects, and write them to splats.ply; there are no masks, and nothing is trained."""
    reporter.expect({READ: ("Preparing", 5.0), KERNELS: ("Preparing", kernel_seconds(opened.device)), **_UNTRAINED})
    strokes = read_strokes(options.strokes, opened.views.names)
    segment = segmentation(options, opened.device)
    ensure_kernels(reporter, opened.device)
    forget_vanished(opened.folder.objects)
    reporter.begin(GRAPH, "Comparing the splats with their neighbors")
    with stage(opened.folder, "label"):
        ids = _solve(opened.pointer(reporter.progress, segment), strokes, reporter)
    reporter.begin(EXPORT, f"Writing {opened.folder.splats.name}")
    write_labeled(opened.folder, splats, ids, strokes.names, reporter)
    for i, count in zip(*(each.tolist() for each in np.unique(ids[ids > 0], return_counts=True)), strict=True):
        reporter.status(f"{strokes.names.get(i) or default_name(i)}: {count:,} splats")
    reporter.done(objects=_number_of(strokes), splats=str(opened.folder.splats))


def _solve(pointer: Pointer, strokes: Strokes, reporter: Reporter) -> np.ndarray:
    """Return the object (N,) of each splat; strokes that show no splats any longer are left out with a warning."""
    return pointer.solve(strokes, lambda error: reporter.warning(f"{error} Its object is found by the other strokes."))


def _number_of(strokes: Strokes) -> int:
    """Return how many objects strokes mark."""
    return len({stroke.object for stroke in strokes.strokes} - {0})


def _require_own_masks(capture: Capture) -> None:
    """Raise InputError if the capture has masks or names that were not made of strokes."""
    folder = capture.folder / "masks"
    own = (folder / STROKES).is_file()
    for path in (folder, capture.folder / "labels.json"):
        if path.exists() and not own:
            raise InputError(f"{path} was not made of strokes; move it elsewhere to make masks of strokes.")


def _other_owner(capture: Capture, folder: Reconstruction) -> Path | None:
    """Return the folder of another reconstruction, if there is one, of whose strokes the capture's masks were made."""
    try:
        owner = Path(read_json(capture.folder / "masks" / STROKES)[_OWNER])
    except (InputError, KeyError, TypeError):
        return None  # There are none, or an older version has made them.
    return owner if owner.is_dir() and owner != folder.folder.resolve() else None


def _write_masks(
    trained: Trained,
    pointer: Pointer,
    ids: np.ndarray,
    strokes: Strokes,
    options: argparse.Namespace,
    reporter: StoppingReporter,
) -> None:
    """Write masks of the training photos, which replace those of earlier strokes when complete, and labels.json.

    A picture of some of them is beside them.
    """
    capture, owner = trained.capture, str(trained.folder.folder.resolve())
    names = {i: strokes.names.get(i) or default_name(i) for i in np.unique(ids).tolist() if i}
    sheet = MaskSheet(len(capture.train_indices))
    with new_masks(capture.folder) as folder:
        for done, (index, mask) in enumerate(pointer.masks(ids), 1):
            write_mask(folder, capture.views[index].name, capture.photo_mask(index, mask))
            sheet.add(capture.views[index].name, mask, partial(capture.image, index))
            reporter.progress(done, len(capture.train_indices), what="photos")
        sheet.save(folder / OVERVIEW, names)
        write_json(folder / STROKES, {**read_json(options.strokes), _OWNER: owner})
    write_json(capture.folder / "labels.json", {str(i): name for i, name in names.items()})
    reporter.status(f"Masks show {sheet.summary()}; see {capture.folder / 'masks' / OVERVIEW}")
    for i, name in names.items():
        reporter.status(f"{name}: in {sheet.photos_of[i]} photos")


def begin_border_training(
    trained: Trained, source: np.ndarray, ids: np.ndarray, options: argparse.Namespace, reporter: StoppingReporter
) -> Trainer:
    """Vote with the masks, plan anew, give the splats their IDs, and save that as the folder's training and splats.

    Nothing in it can be stopped: the masks have been replaced, and the folder has to follow.
    """
    folder, before, going_on = trained.folder, trained.training, reporter.reporter
    wanted, votes = _choices_of(before), before.votes
    capture = load_capture(trained.capture.folder, folder.cache, memory_for_files(options), votes.max_size, going_on)
    voting = argparse.Namespace(strategy=votes.strategy, seed=wanted.settings.seed, max_size=votes.max_size)
    # What is far from all strokes has no object, which is no reason for a warning.
    cast_votes(folder, capture, voting, Reporter())
    # An object that was unchecked since the training has splats, and is separated from the others, too.
    objects = [
        replace(entry, left_out=entry.left_out and entry.id in before.left_out)
        for entry in find_requested_objects(folder, capture)[0]
    ]
    begun = plan_of(before).without("votes")
    points = read_points(folder.points)
    context = build_context(capture, wanted, objects, going_on, points, thorough=True, resumed=begun)
    plan = decide(context).settled_by(begun)
    planned = planned_capture(context.capture, plan)
    semantic_weight = planned_settings(wanted.settings, plan).semantic_weight
    trainer = begin_with_labels(
        source, ids, planned, folder.checkpoint, memory_for_targets(options), trained.model.device,
        trained.scene.gains, planned.has_masks and plan.does("rest"), semantic_weight,
    )  # fmt: skip
    trainer.save(folder.checkpoint)
    (folder.checkpoint / PREVIOUS).unlink(missing_ok=True)
    outdate_results(folder)
    write_plan(folder.plan, plan)
    key = votes_key(planned, votes.max_size, votes.strategy, wanted.settings.seed)
    settings = {**before.settings, "semantic_weight": semantic_weight}
    left_out = planned.left_out.tolist()
    update_record(
        folder, training=replace(before, settings=settings, left_out=left_out, votes=key, plan=plan.as_list())
    )
    # The training may end in any way; what there is to say about its result is said after it.
    export_model(trainer.shown, trainer.scene, folder, Reporter(), compare=False)
    return trainer


def _choices_of(training: TrainingRecord) -> Choices:
    """Return the user's choices for a training, for a plan with other masks."""
    settings, plan = Settings(**training.settings), plan_of(training)
    labels = plan["labels"]
    if settings.semantic_weight == 0 and labels is not None and labels.can_override:
        # There was nothing to learn from the masks so far; otherwise the user has chosen it.
        settings = replace(settings, semantic_weight=Settings().semantic_weight)
    overridden = [decision for decision in plan.without("votes").decisions if decision.overridden]
    return Choices(
        settings,
        training.votes.max_size,
        meshes=plan.does("meshes"),
        keep=[decision.key for decision in overridden if decision.done],
        leave_out=[decision.key for decision in overridden if not decision.done],
        until_converged=training.preset == "final",
    )


def train_borders(trained: Trained, trainer: Trainer, reporter: StoppingReporter) -> None:
    """Train with the masks, and export the model; also if the training is stopped or fails."""
    folder, before = trained.folder, trainer.progress.seconds
    budget = budget_of_labels(trainer.progress.step)
    reporter.begin(_TRAIN, "Training the objects' borders")
    try:
        trainer.run(budget, folder.checkpoint, reporter.reporter, stop=reporter.stop)
    except Cancelled:
        export_model(trainer.shown, trainer.scene, folder, reporter, compare=False)
        raise
    except (InputError, OSError):
        with suppress(InputError, OSError):
            export_model(trainer.shown, trainer.scene, folder, reporter, compare=False)
        raise
    finish_stage(folder, "label training", trainer.progress.seconds - before)
    export_model(trainer.shown, trainer.scene, folder, reporter)


def border_seconds(trained: Trained) -> float:
    """Return the expected duration of the training in seconds."""
    done = trained.progress
    return ((budget_of_labels(done.step).steps or 0) - done.step) * done.seconds / max(done.step, 1)
