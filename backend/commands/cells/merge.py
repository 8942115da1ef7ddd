"""`merge`: join the trained cells of a reconstruction, and train where they meet."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ...model.anchors import Anchors
from ...model.checkpoint import save_checkpoint
from ...shared.errors import InputError
from ...shared.formats.atomic import make_folder, remove_abandoned
from ...shared.reconstruction.folder import Reconstruction
from ...shared.reconstruction.lock import locked
from ...shared.reconstruction.record import update_record
from ...shared.stopping import StoppingReporter
from ...training.budget import Budget, TrainingProgress
from ...training.cells.division import NO_CELL
from ...training.cells.parts import (
    Checkpoint,
    anchors_of,
    begin_seams,
    in_core,
    merged,
    near_seams,
    without_anchors,
)
from ...training.state import Keep, model_from_checkpoint, progress_of
from ...training.trainer import Trainer
from ..exported import EXPORT, export_model
from ..folder import READ, memory_for_targets, outdate_results, require_reconstruction
from ..setup.kernels import PART as KERNELS
from ..setup.kernels import ensure_kernels, kernel_seconds
from ..stages import finish_stage
from .folder import (
    CHECKPOINT,
    RECORD,
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

_SEAMS, _TRAIN, _JOIN = "seams", "train", "join"


def merge(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Replace the reconstruction's model by that of its cells, and export it."""
    reporter.expect(
        {
            READ: ("Preparing", 5.0), KERNELS: ("Preparing", 0.0), _SEAMS: ("Preparing", 5.0),
            _TRAIN: ("Training", 60.0), _JOIN: ("Joining", 5.0), EXPORT: ("Saving", 5.0),
        }
    )  # fmt: skip
    folder = Reconstruction(options.folder)
    require_reconstruction(folder)
    with locked(folder.folder):
        divided = open_divided(options, reporter)
        require_unchanged(folder, divided.division, divided.folders)
        with divided.folders.locked():
            tensors, state, seconds = _merge(divided, options, reporter)
        save_checkpoint(folder.checkpoint, tensors, state)
        outdate_results(folder)
        progress = progress_of(state)
        update_record(folder, training=replace(divided.training, steps=progress.step, minutes=None, preset=None))
        finish_stage(folder, "merge", seconds)
        model = model_from_checkpoint(tensors, state).to(divided.device)
        del tensors
        export_model(model, divided.scene, folder, reporter)
    reporter.done(
        steps=progress.step, seconds=round(progress.seconds, 1), anchors=len(model.anchors), splats=str(folder.splats)
    )


def _merge(
    divided: Divided, options: argparse.Namespace, reporter: StoppingReporter
) -> tuple[dict[str, np.ndarray], dict[str, Any], float]:
    """Return the tensors and the state of the whole model, after the training of the seams, and the seconds of that.

    The cells are read twice, so that not all of them are in memory while the seams are trained.
    """
    division = divided.division
    cells = _finished_cells(divided)
    reporter.expect({KERNELS: ("Preparing", kernel_seconds(divided.device))})
    ensure_kernels(reporter, divided.device)
    coarse, _ = divided.read_coarse(lambda _, cell_of: cell_of == NO_CELL)
    of_none, shared = anchors_of(coarse), without_anchors(coarse)
    del coarse
    most = len(of_none["ids"]) + sum(cell.anchors for cell in cells)
    steps = options.steps or min(max(round(_FRACTION * sum(cell.steps for cell in cells)), 1), _MOST)

    def begin() -> Checkpoint:
        reporter.begin(_SEAMS, "Reading the anchors where cells meet")
        cameras = divided.cameras(division.seam_views)
        near = near_seams(division, cameras)
        cores = (_read_core(divided, number, cell.anchors, near) for number, cell in enumerate(cells))
        return begin_seams(shared, division, of_none, cores, most, cameras)

    seams = _train_seams(divided, begin, steps, options, reporter)
    progress = TrainingProgress(
        step=divided.progress.step + seams.step + sum(cell.steps for cell in cells),
        seconds=divided.progress.seconds + seams.seconds + sum(cell.seconds for cell in cells),
        curve=divided.progress.curve,
    )
    reporter.begin(_JOIN, f"Joining {len(cells)} cells")
    trained = read_part(divided.folders.seams / CHECKPOINT, fixed=False)
    cores = (_read_core(divided, number, cell.anchors) for number, cell in enumerate(cells))
    return *merged(shared, division, of_none, cores, most, trained, progress, divided.key), seams.seconds


def _read_core(divided: Divided, number: int, count: int, keep: Keep | None = None) -> dict[str, np.ndarray]:
    """Return the anchors in the core of a trained cell that `keep` chooses, by default all.

    Raises:
        InputError: there are not `count` of them in all, or the checkpoint is missing or damaged.
    """
    is_core, found = in_core(divided.division, number), 0

    def choose(anchors: Anchors) -> np.ndarray:
        nonlocal found
        core = is_core(anchors)
        found += int(core.sum())
        return core if keep is None else core & keep(anchors)

    folder = divided.folders.cell(number)
    read = anchors_of(read_part(folder / CHECKPOINT, choose, fixed=False))
    if found != count:
        raise InputError(
            f"{folder / CHECKPOINT} has {found} anchors in the core of the cell instead of {count}, so it is not that "
            f"of {folder / RECORD}; run `train-cell` for this cell again."
        )
    return read


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
    begin: Callable[[], Checkpoint],
    steps: int,
    options: argparse.Namespace,
    reporter: StoppingReporter,
) -> TrainingProgress:
    """Train the anchors where cells meet, from the checkpoint that `begin` returns, or go on with that; returns the
    progress."""
    folder, device, gains = divided.folders.seams, divided.device, divided.scene.gains
    of = (divided.key, *(digest_of(divided.folders.cell(n) / CHECKPOINT) for n in range(len(divided.division.cells))))
    memory, capture = memory_for_targets(options), divided.restricted(divided.division.seam_views)
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
        trainer = Trainer.restore(capture, *begin(), memory, device, gains)
        write_part_record(folder, PartRecord(of))
    reporter.begin(_TRAIN, f"Training {len(trainer.model.anchors) - trainer.region.fixed:,} anchors where cells meet")
    if capture.train_indices:
        trainer.run(Budget(steps, first=FIRST), folder / CHECKPOINT, reporter.reporter, stop=reporter.stop)
    else:
        # Cells without overlap have no seams.
        trainer.save(folder / CHECKPOINT)
    return trainer.progress
