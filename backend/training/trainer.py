"""The training loop: one view per step, growth at intervals, checkpoints, and a curve of the quality on held-out views.

The model, its Adam moments and the images are on one device, the CPU or a GPU. On a GPU, steps are asynchronous; their
results are read when the training reports or saves.
"""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..model.checkpoint import Saving, save_checkpoint
from ..model.object_model import ObjectModel
from ..raster import devices
from ..shared.durations import awake_seconds
from ..shared.errors import Cancelled, InputError, ProcessLost, is_lack_of_memory
from ..shared.events import Reporter
from ..shared.formats.atomic import require_still_there
from ..shared.stopping import Check, StopRequest, proceed
from . import check_finite, overfitting
from .budget import Budget, TrainingProgress, objective_of, plateau_end
from .cells.region import Region
from .exposure.photo_colors import begin_colors
from .initial_model import Detail, DistantPoints, initial_model
from .optimizer.model_optimizer import ModelOptimizer
from .processes.shared_views import Outcome, SharedViews
from .processes.team import Order, Processes, Team
from .scene import Scene
from .settings import Settings, background_is_masked
from .state import model_from_checkpoint, read_checkpoint, require_settings, training_state, training_tensors
from .step import ALONE_EVERY, IN_PARTS, ViewGradients, ViewStep

if TYPE_CHECKING:
    from ..capture import Capture

CHECKPOINT_SECONDS = 30.0
_REPORT_SECONDS = 0.5

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
        tensors: dict[str, np.ndarray] | None = None,
    ) -> None:
        self.scene = scene
        self.settings = settings
        self.model = model
        self.rng = rng
        self.progress = TrainingProgress()
        self._smooth = torch.full((), math.nan, device=model.device)
        self.region = region or Region()
        self.optimizer = ModelOptimizer(model, settings, self.region, tensors)
        self.view_step = ViewStep(
            scene, settings, model, self.optimizer.heads, self.optimizer.growth, self.optimizer.check,
            fits_colors=self.region.is_whole,
        )  # fmt: skip
        self.work_with(Team())
        self._warnings: list[str] = []
        # Not before the current checkpoint is known to be complete, and one of this training.
        self._keeps_current = False

    def work_with(self, team: Team) -> None:
        """Train together with other processes from now on, each with views of its own.

        Args:
            team: the processes; the first one calls `run`, the others `follow`.
        """
        self._team = team
        self._shared = SharedViews(team, self.settings.layout.columns, self.optimizer.heads.parameters)

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
        detail: Detail | None = None,
        check: Check = proceed,
    ) -> Trainer:
        """Start a training with anchors at the capture's points.

        Args:
            capture: the views and points.
            point_ids: (M,) int64 object ID of each point, 0 if it belongs to none.
            settings: settings of the training.
            memory_mb, gains: as in `Scene`.
            device: device to train on.
            seeds: as in `initial_model`, as the arguments from `more` on; None: all points.
            supervise_background: as in `Scene`; None: decided by `background_is_masked` for the points without object.

        Raises:
            InputError: an image cannot be read.
        """
        rng = np.random.default_rng(settings.seed)
        seeds = np.ones(len(capture.points.xyz), np.bool_) if seeds is None else seeds
        model = initial_model(capture, point_ids, settings, rng, seeds, more, surroundings, most_anchors, detail, check)
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
        return self.optimizer.average.of(self.model)

    def save(self, folder: Path) -> None:
        """Write a checkpoint with all data that the next step depends on.

        Raises:
            InputError: the checkpoint cannot be written; the previous one is kept.
        """
        model, optimizer = self.model, self.optimizer
        self.progress.skipped += optimizer.check.take_skipped()
        smooth = float(self._smooth)
        self.progress.smooth_loss = smooth if math.isfinite(smooth) else None
        tensors = training_tensors(
            model, optimizer.rows, optimizer.growth, optimizer.average, optimizer.heads, self.view_step.colors,
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
            state["supervise_background"], device, gains, model.blur,
        )  # fmt: skip
        rng = np.random.default_rng()
        rng.bit_generator.state = state["rng"]
        trainer = cls(scene, settings, model.to(device), rng, Region.of(state), tensors)
        trainer.view_step.restore(tensors)
        trainer.progress = TrainingProgress(**state["progress"])
        if trainer.progress.smooth_loss is not None:
            trainer._smooth.fill_(trainer.progress.smooth_loss)
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
        """Train until the budget is spent; pauses do not count.

        Args:
            budget: total length of the training.
            checkpoints: folder for checkpoints, which are written at the end, before a pause, and at intervals, where
                one may fail.
            reporter: receives progress, quality and warnings.
            evaluate: measures the model on validation and, if there is time, held-out views; may raise Cancelled.
            stop: stop and pause request, checked before each step.
            checkpoint_seconds: least time between checkpoints; more if they take long to write.

        Raises:
            Cancelled: a stop was requested; the training is saved.
            InputError, OSError: an image cannot be read or a file cannot be written; the steps so far are saved if
                possible, as for errors that tell a lack of memory.
            ProcessLost: another process of the training has ended; the steps so far are saved.
        """
        first_step = self.progress.step
        try:
            self._train(budget, checkpoints, reporter, evaluate, stop or StopRequest(), checkpoint_seconds)
        except Cancelled:
            self.save(checkpoints)
            raise Cancelled(
                f"Stopped after {self.progress.step} steps; run the same command again to resume."
            ) from None
        except Exception as error:
            expected = isinstance(error, (InputError, OSError, ProcessLost)) or is_lack_of_memory(error)
            if expected and self.progress.step > first_step and self.optimizer.is_complete:
                require_still_there(checkpoints.parent)
                self.scene.forget()
                with suppress(InputError, OSError, MemoryError):
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
        p, before, first_step = self.progress, self.progress.seconds, self.progress.step
        budget.begin(p)
        capture, validation, earlier = self.scene.capture, self.scene.capture.validation_indices, copy.copy(p)
        if self.region.is_whole and not budget.until_converged:
            # They decide on nothing. Those of a cell need not show it.
            p.join(validation)
            begin_colors(self.view_step.colors, self.shown, self.scene, p.joining(earlier, validation))
        if evaluate is not None and not p.step and not validation:
            p.watched = overfitting.choose_watched_views(capture.train_indices, len(capture.points.xyz))
        self._team.tell_state(p.__dict__)  # Returns when the others are ready.
        started = last_report = awake_seconds()
        parts, saving = self.parts, Saving(self.save, checkpoints, checkpoint_seconds, reporter)
        while True:
            p.seconds = before + awake_seconds() - started
            if evaluate is not None and budget.evaluation_is_due(p):
                earlier = copy.copy(p)
                self._evaluate(evaluate, reporter, float(self._smooth), budget.progress(p))
                if budget.check_convergence(p):
                    reporter.status(plateau_end(p))
                    p.join(validation)
                if overfitting.watch(p, budget):
                    reporter.status(overfitting.OVERFITS)
                begin_colors(self.view_step.colors, self.shown, self.scene, p.joining(earlier, validation))
                self._team.tell_state(p.__dict__)
            progress = budget.progress(p)
            if progress >= 1.0:
                break
            if stop.paused:
                saving.save()
            wait_started = awake_seconds()
            if stop():
                raise Cancelled
            waited = awake_seconds() - wait_started
            started, last_report = started + waited, last_report + waited
            saving.delay(waited)
            self._team.tell(Order.STEP, progress, self.optimizer.check.at_once)
            loss = self.step(progress)
            while self._warnings:
                reporter.warning(self._warnings.pop(0))
            smoothed = torch.where(self._smooth.isnan(), loss, self._smooth.lerp(loss, 0.05))
            self._smooth = torch.where(loss.isnan(), self._smooth, smoothed)
            if parts == 1 < self.parts:
                reporter.warning(IN_PARTS.format(parts=self.parts))
                parts = self.parts
            now = awake_seconds()
            if now - last_report >= _REPORT_SECONDS:
                last_report = now
                p.seconds = before + now - started
                self._report(budget, reporter, float(self._smooth), (now - started) / (p.step - first_step))
                self.optimizer.check.watch()
            saving.save_if_due()
        self.save(checkpoints)
        if p.skipped:
            reporter.warning(f"{p.skipped} updates were not finite and were skipped{p.causes and f': {p.causes}'}.")

    def _evaluate(self, evaluate: Evaluate, reporter: Reporter, loss: float, progress: float) -> None:
        p = self.progress
        quality = evaluate(self.shown, self.scene, p)
        loss_db = round(-20 * math.log10(loss), 3) if 0 < loss < math.inf else None
        reached = {"seconds": round(p.seconds, 2), "step": p.step, "anchors": len(self.model.anchors)}
        objective = objective_of(p, self.view_step.largest_downscale(progress))
        p.curve.append({**reached, "loss_db": loss_db, "objective": objective, **quality})
        if "psnr" in quality:
            reporter.quality(**p.curve[-1], zero_is_background=self.scene.supervise_background)

    def _report(self, budget: Budget, reporter: Reporter, loss: float, pace: float) -> None:
        p, latest, left = self.progress, self.progress.latest, budget.remaining(self.progress, pace)
        reporter.progress(
            round(budget.displayed_progress(p), 5),
            1.0,
            step=p.step,
            seconds=round(p.seconds, 1),
            seconds_left=None if left is None else round(left, 1),
            loss=round(loss, 5) if math.isfinite(loss) else None,
            anchors=len(self.model.anchors),
            splats=self.splats,
            **{name: latest.get(name) for name in ("psnr", "miou", "miou_all")},
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
        """Train on one view, or on one in each process: forward, backward and update.

        Args:
            progress: progress of the training, 0 .. 1, which determines learning rates, growth and resolution.

        Returns:
            The loss () float32, the mean over the views; NaN if no anchor is in view or the loss is not finite.
        """
        p, team, optimizer = self.progress, self._team, self.optimizer
        while len(p.queue) < team.size:
            capture = self.scene.capture
            views = [index for index in capture.train_indices if index not in p.watched]
            views += capture.validation_indices if p.joined else ()
            p.queue = self.rng.permutation(views).tolist() + p.queue
        outcomes = self._shared.exchange(*self._compute(progress), len(self.model.anchors))
        # Remove the views only now, so that they remain the next ones if an image cannot be read.
        indices = [p.queue.pop() for _ in outcomes]
        losses, faults = [], []
        for index, (gradients, fault) in zip(indices, outcomes, strict=True):
            p.step += 1
            if gradients is None:
                optimizer.check.skipped += fault is not None
            else:
                losses.append(gradients.loss)
                if self.view_step.colors is not None and gradients.colors is not None:
                    self.view_step.colors.step(index, gradients.colors, progress, gradients.finite)
                optimizer.update(gradients, progress, p.step)
                fault = optimizer.check.take_fault()
            if fault is not None:
                self._note(fault, index)
                faults.append(fault)
        if not optimizer.remove(faults) and losses and optimizer.growth.observes(progress):
            self._grow([outcome.gradients for outcome in outcomes if outcome.gradients is not None], progress)
        if not losses:
            return torch.full((), math.nan, device=self.model.device)
        return losses[0] if len(losses) == 1 else torch.stack(losses).mean()

    def _compute(self, progress: float) -> tuple[Outcome, Exception | None]:
        """Compute the gradients of this process' view; returns them, or the error that prevents it."""
        p, team, step = self.progress, self._team, self.progress.step + self._team.rank
        try:
            if team.rank:
                self.view_step.expected_changes = functools.partial(
                    self.optimizer.expected_changes, count=team.rank, progress=progress, step=p.step
                )
            self.view_step.expect(p.queue[::-1][team.rank :: team.size], progress)
            with self.optimizer.heads_ahead(team.rank, progress):
                gradients = self.view_step.compute(
                    p.queue[-1 - team.rank], progress, overfitting.dropout_at(p, progress, step),
                    alone=step % ALONE_EVERY == 0,
                )  # fmt: skip
        except (InputError, OSError) as error:
            return Outcome(None, None), error
        return Outcome(gradients, self.optimizer.check.take_fault() if gradients is None else None), None

    def _note(self, fault: check_finite.Fault, index: int) -> None:
        """Count a fault in the step on view `index`, and warn if it is the first of its kind."""
        p, capture = self.progress, self.scene.capture
        if fault.what not in p.faults:
            owner = fault.owner(self.model, capture.names)
            self._warnings.append(fault.sentence(p.step, capture.views[index].name, owner))
        p.faults[fault.what] = p.faults.get(fault.what, 0) + 1

    def _grow(self, views: Sequence[ViewGradients], progress: float) -> None:
        """Add the statistics of views, and grow and prune anchors if it is time."""
        p, growth = self.progress, self.optimizer.growth
        for gradients in views:
            if gradients.statistics is not None:
                growth.observe(gradients.statistics, self.settings.offsets, gradients.size)
        if growth.is_due(progress, p.step, p.last_growth):
            p.last_growth = growth.counted_from(p.step, p.last_growth, self._team.size)
            self.optimizer.grow(self.rng)

    def follow(self, team: Processes) -> None:
        """Train with views of this process as the first one tells, until it tells to end.

        Raises:
            InputError: an image cannot be read, in any of the processes.
            ProcessLost: another process has ended.
        """
        self.work_with(team)
        while True:
            order, progress, closely = team.wait()
            if order == Order.STATE:
                before, self.progress = self.progress, TrainingProgress(**team.receive())
                joining = self.progress.joining(before, self.scene.capture.validation_indices)
                begin_colors(self.view_step.colors, self.shown, self.scene, joining)
            elif order == Order.STEP:
                self.optimizer.check.at_once = closely
                self.step(progress)
                self._warnings.clear()
            else:
                return
