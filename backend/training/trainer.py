"""The training loop: one view per step, growth at intervals, checkpoints, and a curve of the quality on held-out views.

The model, its Adam moments and the images are on one device, the CPU or a GPU. On a GPU, steps are asynchronous; their
results are read when the training reports or saves.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..model.checkpoint import save_checkpoint
from ..model.object_model import ObjectModel
from ..raster import devices
from ..shared.errors import Cancelled, InputError
from ..shared.events import Reporter
from ..shared.reconstruction.objects import default_name
from ..shared.stopping import StopRequest
from . import check_finite, overfitting
from .budget import Budget, TrainingProgress
from .cells.region import Region
from .check_finite import FiniteCheck
from .growth_strategy import GrowthStrategy
from .initial_model import DistantPoints, initial_model
from .optimizer.average import Average
from .optimizer.head_adam import HeadAdam
from .optimizer.row_adam import RowAdam
from .scene import Scene
from .settings import HEAD_RATES, Settings, background_is_masked, rate, row_rates
from .state import (
    model_from_checkpoint,
    read_checkpoint,
    require_settings,
    restore_statistics,
    training_state,
    training_tensors,
)
from .step import ALONE_EVERY, IN_PARTS, ViewGradients, ViewStep

if TYPE_CHECKING:
    from ..capture import Capture

CHECKPOINT_SECONDS = 30.0
_REPORT_SECONDS = 0.5
_CONVERGED = "The training has converged; its learning rates fall from step {steps:,} on"

Evaluate = Callable[[ObjectModel, Scene, TrainingProgress], dict[str, Any]]


class Trainer:
    """A model in training. Create one with `start` or `resume`, then call `run`."""

    def __init__(
        self,
        scene: Scene,
        settings: Settings,
        model: ObjectModel,
        rng: np.random.Generator,
        region: Region | None = None,
    ) -> None:
        self.scene = scene
        self.settings = settings
        self.model = model
        self.rng = rng
        self.progress = TrainingProgress()
        self.region = region or Region()
        self.row_optimizer = RowAdam(model.anchors.rows, self.region.fixed)
        self._warnings: list[str] = []
        # Not before the current checkpoint is known to be complete, and one of this training.
        self._keeps_current = False
        self._average = Average(model, self.region.fixed)
        whole = self.region.is_whole
        model.background.requires_grad_(settings.background == "learned" and whole)
        model.heads.requires_grad_(whole)
        names = [name for name in HEAD_RATES if name != "background"]
        heads = {name: list(getattr(model.heads, name).parameters()) for name in names}
        self._head_optimizer = HeadAdam({**heads, "background": [model.background]})
        self._check = FiniteCheck(model.device)
        self._growth = GrowthStrategy(settings, model, self.region)
        self.view_step = ViewStep(
            scene, settings, model, self._head_optimizer, self._growth, self._check, fits_colors=whole
        )

    @classmethod
    def start(
        cls,
        capture: Capture,
        point_ids: np.ndarray,
        settings: Settings,
        memory_mb: float = 2000,
        device: torch.device = devices.CPU,
        *,
        seeds: np.ndarray | None = None,
        supervise_background: bool | None = None,
        gains: np.ndarray | None = None,
        more: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
        surroundings: DistantPoints | None = None,
        most_anchors: int | None = None,
    ) -> Trainer:
        """Start a training with anchors at the capture's points.

        Args:
            capture: the views and points.
            point_ids: (M,) int64 object ID of each point, 0 if it belongs to none.
            settings: settings of the training.
            memory_mb: memory limit for cached targets.
            device: device to train on.
            seeds, more, surroundings, most_anchors: as in `initial_model`; seeds may be None for all points.
            supervise_background: as in `Scene`; None: decided by `background_is_masked` for the points without object.
            gains: as in `Scene`.

        Raises:
            InputError: an image cannot be read.
        """
        rng = np.random.default_rng(settings.seed)
        seeds = np.ones(len(capture.points.xyz), np.bool_) if seeds is None else seeds
        model = initial_model(capture, point_ids, settings, rng, seeds, more, surroundings, most_anchors)
        if supervise_background is None:
            supervise_background = capture.has_masks and background_is_masked(point_ids[seeds] == 0)
        scene = Scene(
            capture, model.classes, model.normalization, settings.zero_is_object, memory_mb, supervise_background,
            device, gains,
        )  # fmt: skip
        return cls(scene, settings, model.to(device), rng)

    @property
    def shown(self) -> ObjectModel:
        """The model to display, evaluate and export: the mean over the latest steps."""
        return self._average.of(self.model)

    def save(self, folder: Path) -> None:
        """Write a checkpoint with all data that the next step depends on.

        Raises:
            InputError: the checkpoint cannot be written; the previous one is kept.
        """
        model = self.model
        self.progress.skipped += self._check.take_skipped()
        tensors = training_tensors(
            model, self.row_optimizer, self._growth.statistics, self._average, self._head_optimizer,
            self.view_step.colors,
        )  # fmt: skip
        state = training_state(
            self.settings, model, self.scene.supervise_background, self.rng, self.progress, self.region
        )
        save_checkpoint(folder, tensors, state, keep_current=self._keeps_current)
        self._keeps_current = True

    @classmethod
    def resume(
        cls,
        capture: Capture,
        folder: Path,
        settings: Settings | None = None,
        memory_mb: float = 2000,
        device: torch.device = devices.CPU,
        gains: np.ndarray | None = None,
    ) -> tuple[Trainer, str | None] | None:
        """Resume the training of the latest complete checkpoint.

        Args:
            capture: the capture that the checkpoint was trained on.
            folder: folder of the checkpoints.
            settings: the requested settings; None: those of the checkpoint.
            memory_mb, gains, device: as in `start`; the device may be another one.

        Returns:
            The trainer, and a warning or None; None if there is no checkpoint.

        Raises:
            InputError: the checkpoint was trained with other settings, or cannot be read.
        """
        found = read_checkpoint(folder)
        if found is None:
            return None
        tensors, state, warning = found
        if settings is not None:
            require_settings(settings, state, folder)
        trainer = cls.restore(capture, tensors, state, memory_mb, device, gains)
        trainer._keeps_current = warning is None
        return trainer, warning

    @classmethod
    def restore(
        cls,
        capture: Capture,
        tensors: dict[str, np.ndarray],
        state: dict[str, Any],
        memory_mb: float,
        device: torch.device,
        gains: np.ndarray | None,
    ) -> Trainer:
        """Return the trainer of a checkpoint's tensors and state; other arguments as in `resume`."""
        model = model_from_checkpoint(tensors, state)
        settings = Settings(**state["settings"])
        scene = Scene(
            capture, model.classes, model.normalization, settings.zero_is_object, memory_mb,
            state["supervise_background"], device, gains,
        )  # fmt: skip
        rng = np.random.default_rng()
        rng.bit_generator.state = state["rng"]
        region = Region.of(state)
        trainer = cls(scene, settings, model.to(device), rng, region)
        trainer.row_optimizer.restore(tensors)
        trainer._growth.statistics = restore_statistics(tensors, device)
        trainer._head_optimizer.restore(tensors)
        trainer._average = Average.from_checkpoint(tensors, trainer.model, region.fixed)
        trainer.view_step.restore(tensors)
        trainer.progress = TrainingProgress(**state["progress"])
        return trainer

    def run(
        self,
        budget: Budget,
        checkpoints: Path,
        reporter: Reporter,
        evaluate: Evaluate | None = None,
        stop: StopRequest | None = None,
        checkpoint_seconds: float = CHECKPOINT_SECONDS,
    ) -> None:
        """Train until the budget is spent.

        Pauses do not count as training time.

        Args:
            budget: total length of the training.
            checkpoints: folder for checkpoints, which are written at the end, before a pause, and at intervals.
            reporter: receives progress, quality and warnings.
            evaluate: function that measures the model on held-out and validation views, and may leave out the former.
            stop: stop and pause request, checked before each step.
            checkpoint_seconds: interval between checkpoints.

        Raises:
            Cancelled: a stop was requested; the training is saved.
            InputError, OSError: an image cannot be read or a file cannot be written; the steps so far are saved if
                possible.
        """
        first_step = self.progress.step
        try:
            self._train(budget, checkpoints, reporter, evaluate, stop or StopRequest(), checkpoint_seconds)
        except (InputError, OSError):
            if self.progress.step > first_step:
                with suppress(InputError, OSError):
                    self.save(checkpoints)
            raise

    def _train(
        self,
        budget: Budget,
        checkpoints: Path,
        reporter: Reporter,
        evaluate: Evaluate | None,
        stop: StopRequest,
        checkpoint_seconds: float,
    ) -> None:
        p = self.progress
        started = last_saved = last_report = time.monotonic()
        before = p.seconds
        first_step = p.step
        budget.begin(p)
        capture = self.scene.capture
        if evaluate is not None and not p.step and not capture.validation_indices:
            p.watched = overfitting.choose_watched_views(capture.train_indices, len(capture.points.xyz))
        smooth = torch.full((), math.nan, device=self.model.device)
        parts = self.parts
        while True:
            p.seconds = before + time.monotonic() - started
            if evaluate is not None and budget.evaluation_is_due(p):
                self._evaluate(evaluate, reporter, float(smooth))
                if budget.check_convergence(p):
                    reporter.status(_CONVERGED.format(steps=p.step))
                if overfitting.watch(p, budget):
                    reporter.status(overfitting.OVERFITS)
            progress = budget.progress(p)
            if progress >= 1.0:
                break
            if stop.paused:
                self.save(checkpoints)
                last_saved = time.monotonic()
            wait_started = time.monotonic()
            stopped = stop()
            waited = time.monotonic() - wait_started
            started, last_saved, last_report = started + waited, last_saved + waited, last_report + waited
            if stopped:
                self.save(checkpoints)
                raise Cancelled(f"Stopped after {p.step} steps; run the same command again to resume.")
            loss = self.step(progress)
            while self._warnings:
                reporter.warning(self._warnings.pop(0))
            smooth = torch.where(smooth.isnan(), loss, smooth.lerp(loss, 0.05))
            if parts == 1 < self.parts:
                reporter.warning(IN_PARTS.format(parts=self.parts))
                parts = self.parts
            now = time.monotonic()
            if now - last_report >= _REPORT_SECONDS:
                last_report = now
                p.seconds = before + now - started
                self._report(budget, reporter, float(smooth), (now - started) / (p.step - first_step))
                self._check.watch()
            if now - last_saved >= checkpoint_seconds:
                self.save(checkpoints)
                last_saved = time.monotonic()
        self.save(checkpoints)
        if p.skipped:
            reporter.warning(f"{p.skipped} updates were not finite and were skipped{p.causes and f': {p.causes}'}.")

    def _evaluate(self, evaluate: Evaluate, reporter: Reporter, loss: float) -> None:
        p = self.progress
        quality = evaluate(self.shown, self.scene, p)
        loss_db = round(-20 * math.log10(loss), 3) if 0 < loss < math.inf else None
        reached = {"seconds": round(p.seconds, 2), "step": p.step, "anchors": len(self.model.anchors)}
        p.curve.append({**reached, "loss_db": loss_db, **quality})
        if "psnr" in quality:
            reporter.quality(**p.curve[-1], zero_is_background=self.scene.supervise_background)

    def _report(self, budget: Budget, reporter: Reporter, loss: float, pace: float) -> None:
        p, left = self.progress, budget.remaining(self.progress, pace)
        latest = p.latest
        reporter.progress(
            round(budget.displayed_progress(p), 5),
            1.0,
            step=p.step,
            seconds=round(p.seconds, 1),
            seconds_left=None if left is None else round(left, 1),
            loss=round(loss, 5) if math.isfinite(loss) else None,
            anchors=len(self.model.anchors),
            splats=self.splats,
            psnr=latest.get("psnr"),
            miou=latest.get("miou"),
            miou_all=latest.get("miou_all"),
            zero_is_background=self.scene.supervise_background,
        )

    @property
    def parts(self) -> int:
        """The number of parts in which an image is rendered."""
        return self.view_step.parts

    @property
    def splats(self) -> int:
        """Number of splats generated in the latest step; synchronizes with the GPU."""
        return self.view_step.splats

    def step(self, progress: float) -> torch.Tensor:
        """Train on one view: forward, backward and update.

        Args:
            progress: progress of the training, 0 .. 1, which determines learning rates, growth and resolution.

        Returns:
            The loss () float32; NaN if no anchor is in view or the loss is not finite.
        """
        p = self.progress
        if not p.queue:
            views = [index for index in self.scene.capture.train_indices if index not in p.watched]
            p.queue = self.rng.permutation(views).tolist()
        self.view_step.expect(p.queue[::-1], progress)
        gradients = self.view_step.compute(
            p.queue[-1], progress, overfitting.dropout_at(p, progress), alone=p.step % ALONE_EVERY == 0
        )
        # Remove the view only now, so that it remains the next one if its image cannot be read.
        index = p.queue.pop()
        p.step += 1
        if gradients is None:
            loss = torch.full((), math.nan, device=self.model.device)
        else:
            loss = gradients.loss
            self._update(gradients, progress)
            self._average.follow(self.model, p.step)
        before = len(self.model.anchors)
        if (fault := self._check.take_fault()) is not None:
            self._handle(fault, index)
        if gradients is not None and self._growth.observes(progress) and len(self.model.anchors) == before:
            self._grow(gradients, progress)
        return loss

    def _handle(self, fault: check_finite.Fault, index: int) -> None:
        """Count a fault in the step on view `index`, and remove anchors with non-finite parameters.

        Warns if the fault is the first of its kind.
        """
        p, model, capture = self.progress, self.model, self.scene.capture
        if fault.what not in p.faults:
            owner = None
            if len(fault.anchors):
                object_id = int(model.classes.ids_of(int(model.anchors.ids[fault.anchors[0]])))
                owner = capture.names.get(object_id, default_name(object_id) if object_id else "no object")
            self._warnings.append(fault.sentence(p.step, capture.views[index].name, owner))
        p.faults[fault.what] = p.faults.get(fault.what, 0) + 1
        if not len(fault.unrecoverable):
            return
        a = model.anchors
        kept = torch.ones(len(a), dtype=torch.bool, device=model.device)
        kept[fault.unrecoverable] = False
        # Those were finite before the training, and are none of its business.
        kept[: self.region.fixed] = True
        a.positions, a.rows, a.ids = a.positions[kept], a.rows[kept], a.ids[kept]
        kept = kept[self.region.fixed :]
        self.row_optimizer.take(kept, 0)
        self._average.take(kept, a.rows[:0])
        self._growth.clear(model)

    def _update(self, gradients: ViewGradients, progress: float) -> None:
        optimizer = self._head_optimizer
        of_heads = {
            name: [parameter.grad for parameter in group if parameter.grad is not None]
            for name, group in optimizer.groups.items()
        }
        skipped: int | torch.Tensor = 0
        if self.region.is_whole:
            skipped = ~optimizer.step(
                {name: rate(HEAD_RATES[name], progress) for name in optimizer.groups}, gradients.finite
            )
        assert gradients.rows.grad is not None
        skipped = skipped + self.row_optimizer.step(
            self.model.anchors.rows, gradients.seen, gradients.rows.grad, row_rates(self.settings, progress),
            self.progress.step, gradients.usable,
        )  # fmt: skip
        self._check.skipped += skipped
        if self._check.at_once and skipped:
            self._check.fault = check_finite.find_fault_of_rows(
                gradients.rows.grad, gradients.rows.detach(), gradients.seen, self.settings.layout
            ) or check_finite.find_fault_of_heads(of_heads)

    def _grow(self, gradients: ViewGradients, progress: float) -> None:
        p, anchors, camera = self.progress, self.model.anchors, gradients.camera
        self._growth.observe(
            gradients.statistics, anchors.layout.offsets, camera.width, camera.height, gradients.usable
        )
        if not self._growth.is_due(progress, p.step, p.last_growth):
            return
        p.last_growth = p.step
        growth = self._growth.grow(self.model, self.rng)
        # All fixed anchors are kept.
        kept = growth.kept[self.region.fixed :] - self.region.fixed
        self.row_optimizer.take(kept, growth.added)
        self._average.take(kept, anchors.rows[len(anchors) - growth.added :])
