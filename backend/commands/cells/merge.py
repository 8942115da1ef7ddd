"""`merge`: join the trained cells of a reconstruction, and train where they meet."""

from __future__ import annotations

import argparse
import shutil
from dataclasses import replace

import numpy as np

from ...model.checkpoint import save_checkpoint
from ...shared.errors import InputError
from ...shared.formats.atomic import make_folder, remove_abandoned
from ...shared.reconstruction.lock import locked
from ...shared.reconstruction.record import update_record
from ...shared.stopping import StoppingReporter
from ...training.budget import Budget, TrainingProgress
from ...training.cells.division import NO_CELL
from ...training.cells.parts import begin_seams, join_cells, merged
from ...training.state import load_model
from ...training.trainer import Trainer
from ..exported import EXPORT, export_model
from ..folder import READ, memory_for_targets, outdate_results
from ..setup.kernels import PART as KERNELS
from ..setup.kernels import ensure_kernels, kernel_seconds
from ..stages import finish_stage
from .folder import (
    CHECKPOINT,
    Divided,
    PartRecord,
    digest_of,
    open_divided,
    read_part,
    read_part_record,
    require_unchanged,
    write_part_record,
)

FIRST = 0.7
"""Progress at the first step of the seams, which determines the learning rates; no anchors grow from there on."""

_FRACTION, _MOST = 0.05, 2000
"""Number of steps of the seams, relative to the sum of those of all cells, and at most."""

_JOIN, _TRAIN = "join", "train"


def merge(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Replace the reconstruction's model by that of its cells, and export it."""
    reporter.expect(
        {
            READ: ("Preparing", 5.0), KERNELS: ("Preparing", 0.0), _JOIN: ("Joining", 5.0),
            _TRAIN: ("Training", 60.0), EXPORT: ("Saving", 5.0),
        }
    )  # fmt: skip
    divided = open_divided(options, reporter)
    folder, device = divided.trained.folder, divided.trained.model.device
    cells = _finished_cells(divided)
    with locked(folder.folder):
        require_unchanged(folder, divided.division, divided.folders)
        reporter.begin(_JOIN, f"Joining {len(cells)} cells")
        parts = [divided.folders.cell(number) / CHECKPOINT for number in range(len(cells))]
        of = (divided.key, *map(digest_of, parts))
        counts = [cell.anchors for cell in cells]
        joined = join_cells(divided.coarse, divided.division, divided.cell_of, map(read_part, parts), counts)
        steps = options.steps or min(max(round(_FRACTION * sum(cell.steps for cell in cells)), 1), _MOST)
        reporter.expect({KERNELS: ("Preparing", kernel_seconds(device))})
        ensure_kernels(reporter, device)
        seams = _train_seams(divided, joined, steps, of, options, reporter)
        spent = [divided.trained.progress, seams]
        progress = TrainingProgress(
            step=sum(p.step for p in spent) + sum(cell.steps for cell in cells),
            seconds=sum(p.seconds for p in spent) + sum(cell.seconds for cell in cells),
            curve=divided.trained.progress.curve,
        )
        surroundings = int((divided.cell_of == NO_CELL).sum())
        tensors, state = merged(
            divided.coarse,
            divided.division,
            joined,
            surroundings,
            read_part(divided.folders.seams / CHECKPOINT),
            progress,
            divided.key,
        )
        save_checkpoint(folder.checkpoint, tensors, state)
        del tensors, joined
        outdate_results(folder)
        update_record(
            folder, training=replace(divided.trained.training, steps=progress.step, minutes=None, preset=None)
        )
        finish_stage(folder, "merge", seams.seconds)
        model = load_model(folder.checkpoint, device)[0]
        export_model(model, divided.trained.scene, folder, reporter)
    reporter.done(
        steps=progress.step, seconds=round(progress.seconds, 1), anchors=len(model.anchors), splats=str(folder.splats)
    )


def _finished_cells(divided: Divided) -> list[PartRecord]:
    """Return the records of all cells; raise InputError if one is not trained."""
    found = []
    for number in range(len(divided.division.cells)):
        record = read_part_record(divided.folders.cell(number))
        if record is None or not record.complete or record.made_of != (divided.key,):
            raise InputError(
                f"Cell {number} of {divided.trained.folder.folder} is not trained to its end; run "
                f"`train-cell {divided.trained.folder.folder} --cell {number}` first."
            )
        found.append(record)
    return found


def _train_seams(
    divided: Divided,
    joined: dict[str, np.ndarray],
    steps: int,
    of: tuple[str, ...],
    options: argparse.Namespace,
    reporter: StoppingReporter,
) -> TrainingProgress:
    """Train the joined anchors where cells meet, or go on with that; returns the progress."""
    folder, device, scene = divided.folders.seams, divided.trained.model.device, divided.trained.scene
    names, memory = divided.division.seam_views, memory_for_targets(options)
    capture = divided.restricted(names)
    make_folder(folder)
    remove_abandoned(folder)
    record = read_part_record(folder)
    resumed = None
    if record is not None and record.made_of == of:
        resumed = Trainer.resume(capture, folder / CHECKPOINT, None, memory, device, scene.gains)
    if resumed is not None:
        trainer, warning = resumed
        if warning:
            reporter.warning(warning)
    else:
        shutil.rmtree(folder / CHECKPOINT, ignore_errors=True)
        surroundings = int((divided.cell_of == NO_CELL).sum())
        begun = begin_seams(divided.coarse, divided.division, joined, surroundings, divided.cameras(names))
        trainer = Trainer.restore(capture, *begun, memory, device, scene.gains)
        write_part_record(folder, PartRecord(of))
    reporter.begin(_TRAIN, f"Training {len(trainer.model.anchors) - trainer.region.fixed:,} anchors where cells meet")
    if capture.train_indices:
        trainer.run(Budget(steps, first=FIRST), folder / CHECKPOINT, reporter.reporter, stop=reporter.stop)
    else:
        # Cells without overlap have no seams.
        trainer.save(folder / CHECKPOINT)
    return trainer.progress
