"""`merge`: join the trained cells of a reconstruction, and train where they meet."""

from __future__ import annotations

import argparse
import shutil
from dataclasses import replace

import numpy as np

from ...model.checkpoint import save_checkpoint
from ...shared.errors import InputError
from ...shared.formats.atomic import make_folder, remove_abandoned
from ...shared.reconstruction.folder import Reconstruction
from ...shared.reconstruction.lock import locked
from ...shared.reconstruction.record import update_record
from ...shared.stopping import StoppingReporter
from ...training.budget import Budget, TrainingProgress
from ...training.cells.division import NO_CELL
from ...training.cells.parts import Checkpoint, anchors_of, begin_seams, join_cells, merged, without_anchors
from ...training.state import load_model
from ...training.trainer import Trainer
from ..exported import EXPORT, export_model
from ..folder import READ, memory_for_targets, outdate_results, require_reconstruction
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
    folder = Reconstruction(options.folder)
    require_reconstruction(folder)
    with locked(folder.folder):
        divided = open_divided(options, reporter)
        require_unchanged(folder, divided.division, divided.folders)
        device = divided.device
        with divided.folders.locked():
            cells = _finished_cells(divided)
            reporter.begin(_JOIN, f"Joining {len(cells)} cells")
            parts = [divided.folders.cell(number) / CHECKPOINT for number in range(len(cells))]
            counts = [cell.anchors for cell in cells]
            coarse, _ = divided.read_coarse(lambda _, cell_of: cell_of == NO_CELL)
            of_none, shared = anchors_of(coarse), without_anchors(coarse)
            joined = join_cells(of_none, divided.division, map(read_part, parts), counts)
            of = (divided.key, *map(digest_of, parts))
        surroundings = len(of_none["ids"])
        del coarse, of_none
        steps = options.steps or min(max(round(_FRACTION * sum(cell.steps for cell in cells)), 1), _MOST)
        reporter.expect({KERNELS: ("Preparing", kernel_seconds(device))})
        ensure_kernels(reporter, device)
        seams = _train_seams(divided, shared, joined, surroundings, steps, of, options, reporter)
        spent = [divided.progress, seams]
        progress = TrainingProgress(
            step=sum(p.step for p in spent) + sum(cell.steps for cell in cells),
            seconds=sum(p.seconds for p in spent) + sum(cell.seconds for cell in cells),
            curve=divided.progress.curve,
        )
        trained = read_part(divided.folders.seams / CHECKPOINT)
        tensors, state = merged(shared, divided.division, joined, surroundings, trained, progress, divided.key)
        save_checkpoint(folder.checkpoint, tensors, state)
        del tensors, joined, trained
        outdate_results(folder)
        update_record(folder, training=replace(divided.training, steps=progress.step, minutes=None, preset=None))
        finish_stage(folder, "merge", seams.seconds)
        model = load_model(folder.checkpoint, device)[0]
        export_model(model, divided.scene, folder, reporter)
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
                f"Cell {number} of {divided.folder.folder} is not trained to its end; run "
                f"`train-cell {divided.folder.folder} --cell {number}` first."
            )
        found.append(record)
    return found


def _train_seams(
    divided: Divided,
    shared: Checkpoint,
    joined: dict[str, np.ndarray],
    surroundings: int,
    steps: int,
    of: tuple[str, ...],
    options: argparse.Namespace,
    reporter: StoppingReporter,
) -> TrainingProgress:
    """Train the joined anchors where cells meet, or go on with that; returns the progress."""
    folder, device, gains = divided.folders.seams, divided.device, divided.scene.gains
    names, memory = divided.division.seam_views, memory_for_targets(options)
    capture = divided.restricted(names)
    make_folder(folder)
    remove_abandoned(folder)
    resumed = None
    try:
        record = read_part_record(folder)
        if record is not None and record.made_of == of:
            resumed = Trainer.resume(capture, folder / CHECKPOINT, None, memory, device, gains)
    except InputError:
        reporter.warning(f"{folder} is damaged, so the training where cells meet begins anew.")
    if resumed is not None:
        trainer, warning = resumed
        if warning:
            reporter.warning(warning)
    else:
        shutil.rmtree(folder / CHECKPOINT, ignore_errors=True)
        begun = begin_seams(shared, divided.division, joined, surroundings, divided.cameras(names))
        trainer = Trainer.restore(capture, *begun, memory, device, gains)
        del begun
        write_part_record(folder, PartRecord(of))
    reporter.begin(_TRAIN, f"Training {len(trainer.model.anchors) - trainer.region.fixed:,} anchors where cells meet")
    if capture.train_indices:
        trainer.run(Budget(steps, first=FIRST), folder / CHECKPOINT, reporter.reporter, stop=reporter.stop)
    else:
        # Cells without overlap have no seams.
        trainer.save(folder / CHECKPOINT)
    return trainer.progress
