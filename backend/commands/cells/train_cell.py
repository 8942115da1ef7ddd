"""`train-cell`: train one cell of a divided reconstruction, or go on where that was stopped."""

from __future__ import annotations

import argparse
import shutil
from dataclasses import replace

import numpy as np

from ...model.anchors import Anchors
from ...model.checkpoint import has_checkpoint
from ...shared.durations import Limit
from ...shared.errors import InputError
from ...shared.formats.atomic import make_folder, remove_abandoned
from ...shared.reconstruction.lock import locked
from ...shared.stopping import StoppingReporter
from ...training.budget import Budget
from ...training.cells.parts import Checkpoint, begin_cell, shown, trained_in
from ...training.cells.region import inside
from ...training.trainer import Trainer
from ..folder import READ, memory_for_targets
from ..setup.kernels import PART as KERNELS
from ..setup.kernels import ensure_kernels, kernel_seconds
from ..training.memory import warn_of_memory
from .folder import CHECKPOINT, Divided, PartRecord, open_divided, read_part_record, write_part_record

FIRST = 0.1
"""Progress at the first step: the coarse model is there, and anchors begin to grow."""

_TRAIN = "train"


def train_cell(options: argparse.Namespace, reporter: StoppingReporter) -> None:
    """Train a cell in its own folder; nothing else is written, so that others may train other cells."""
    seconds = None if options.minutes is None else 60 * options.minutes
    expected = Limit(seconds) if seconds else 300.0
    reporter.expect({READ: ("Preparing", 5.0), KERNELS: ("Preparing", 0.0), _TRAIN: ("Training", expected)})
    number = options.cell
    divided = open_divided(options, reporter, number)
    division, device = divided.division, divided.device
    steps = options.steps or (None if seconds else max(divided.progress.step, 1))
    budget = Budget(steps, seconds, first=FIRST)
    folder = divided.folders.cell(number)
    make_folder(folder)
    with locked(folder):
        divided.require_current()
        remove_abandoned(folder)
        record = PartRecord((divided.key,))
        before = None if options.restart else read_part_record(folder)
        if before is None or before.made_of != record.made_of:
            write_part_record(folder, record)
            if (folder / CHECKPOINT).exists():
                shutil.rmtree(folder / CHECKPOINT)
        options.restart = False  # The same command would discard what is trained from now on.
        trainer = _open(divided, number, options, reporter)
        if budget.progress(trainer.progress) >= 1:
            reporter.status(
                f"Cell {number} is already trained for {trainer.progress.step} steps; specify more --minutes or "
                "--steps to extend it, or --restart to start over."
            )
        else:
            write_part_record(folder, record)
            warn_of_memory(trainer, options.memory_mb, reporter)
            reporter.expect({KERNELS: ("Preparing", kernel_seconds(device))})
            ensure_kernels(reporter, device)
            reporter.begin(_TRAIN, f"Training {_trained(trainer):,} anchors of cell {number}")
            trainer.run(
                budget, folder / CHECKPOINT, reporter.reporter, stop=reporter.stop,
                checkpoint_seconds=options.checkpoint_seconds,
            )  # fmt: skip
        fixed, positions, p = trainer.region.fixed, trainer.model.anchors.positions.cpu().numpy(), trainer.progress
        kept = int(inside(positions[fixed:], division.cells[number].core).sum())
        write_part_record(
            folder, replace(record, complete=True, steps=p.step, seconds=round(p.seconds, 2), anchors=kept)
        )
    reporter.done(steps=trainer.progress.step, seconds=round(trainer.progress.seconds, 1), anchors=_trained(trainer))


def _open(divided: Divided, number: int, options: argparse.Namespace, reporter: StoppingReporter) -> Trainer:
    """Return the trainer of a cell, resumed if it was begun before."""
    cell, most = divided.division.cells[number], options.max_anchors
    capture, checkpoint = divided.restricted(cell.views), divided.folders.cell(number) / CHECKPOINT
    memory, device, gains = memory_for_targets(options), divided.device, divided.scene.gains
    if has_checkpoint(checkpoint):
        resumed = Trainer.resume(capture, checkpoint, None, memory, device, gains)
        assert resumed is not None
        trainer, warning = resumed
        if most not in (None, trainer.settings.max_anchors):
            raise InputError(
                f"Cell {number} was begun with --max-anchors {trainer.settings.max_anchors}; use the same, or "
                "--restart to start over."
            )
        if warning:
            reporter.warning(warning)
            # Even if nothing is left to train, the damaged one is replaced.
            trainer.save(checkpoint)
        return trainer
    tensors, state = _begin(divided, number)
    if most is not None:
        state["settings"] = {**state["settings"], "max_anchors": most}
    return Trainer.restore(capture, tensors, state, memory, device, gains)


def _begin(divided: Divided, number: int) -> Checkpoint:
    """Return the checkpoint with which a cell begins."""
    division = divided.division
    cameras = divided.cameras(division.cells[number].views)

    def is_needed(anchors: Anchors, cell_of: np.ndarray) -> np.ndarray:
        return trained_in(division, number, anchors.positions.numpy(), cell_of) | shown(anchors, cameras)

    coarse, cell_of = divided.read_coarse(is_needed)
    return begin_cell(coarse, division, number, cell_of)


def _trained(trainer: Trainer) -> int:
    """Return the number of anchors that are trained."""
    return len(trainer.model.anchors) - trainer.region.fixed
