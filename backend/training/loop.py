"""The training loop: one view a step, growth now and then, checkpoints, a curve of held-out quality over time."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..capture import Capture
from ..model.anchors import Anchors, median_spacing, seed_anchors
from ..model.checkpoint import load_checkpoint, save_checkpoint
from ..model.generate import generate
from ..model.growth import GrowthStatistics, grow_and_prune
from ..model.heads import Heads
from ..model.object_model import Normalization, ObjectModel, anchors_in_view
from ..protocol import Cancelled, InputError, Reporter
from ..raster import Rendered, rasterize
from ..stopping import StopRequest
from .adam import BETA1, BETA2, step_rows, take_rows
from .losses import image_loss, normal_loss, volume_loss
from .scene import Scene
from .settings import (
    GROW_EVERY,
    GROW_FROM,
    GROW_UNTIL,
    HEAD_RATES,
    REST_FROM,
    SURFACE_FROM,
    Settings,
    downscale_at,
    rate,
    row_rates,
)

CHECKPOINT_SECONDS = 30.0
_REPORT_SECONDS = 0.5
_EVALUATIONS = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 1.0)

Evaluate = Callable[[ObjectModel, Scene], dict[str, Any]]


@dataclass(frozen=True)
class Budget:
    """How long to train in all: so many steps, or so many seconds (schedules then follow the clock)."""

    steps: int | None = None
    seconds: float | None = None

    def share(self, step: int, seconds: float) -> float:
        """How much of the budget is spent, 0 to 1."""
        if self.steps is not None:
            return min(step / self.steps, 1.0)
        assert self.seconds is not None
        return min(seconds / self.seconds, 1.0)

    def remaining(self, step: int, seconds: float, pace: float) -> float:
        """Seconds left, given the seconds a step takes."""
        if self.steps is not None:
            return max(self.steps - step, 0) * pace
        assert self.seconds is not None
        return max(self.seconds - seconds, 0.0)


@dataclass
class Progress:
    """Where a training stands; saved with every checkpoint. `curve` has one entry an evaluation."""

    step: int = 0
    seconds: float = 0.0
    last_growth: int = 0
    skipped: int = 0
    queue: list[int] = field(default_factory=list)
    evaluated: int = 0
    curve: list[dict[str, Any]] = field(default_factory=list)


class Trainer:
    """One model in training. Create with `start` or `resume`, then `run`."""

    def __init__(self, scene: Scene, settings: Settings, model: ObjectModel, rng: np.random.Generator) -> None:
        self.scene = scene
        self.settings = settings
        self.model = model
        self.rng = rng
        self.progress = Progress()
        anchors = model.anchors
        self._first = np.zeros_like(anchors.rows)
        self._second = np.zeros_like(anchors.rows)
        self._statistics = GrowthStatistics.zeros(len(anchors), anchors.layout.offsets)
        model.background.requires_grad_(settings.background == "learned")
        groups: list[dict[str, Any]] = [
            {"params": list(getattr(model.heads, name).parameters()), "name": name, "lr": ends[0]}
            for name, ends in HEAD_RATES.items()
            if name != "background"
        ]
        groups.append({"params": [model.background], "name": "background", "lr": HEAD_RATES["background"][0]})
        self._head_optimizer = torch.optim.Adam(groups, betas=(BETA1, BETA2), eps=1e-15, foreach=True)

    @classmethod
    def start(cls, capture: Capture, point_ids: np.ndarray, settings: Settings, memory_mb: float = 2000) -> Trainer:
        """A fresh model on the capture's points, whose objects are point_ids ((M,) int64)."""
        rng = np.random.default_rng(settings.seed)
        xyz = capture.points.xyz
        eyes = np.array([-v.viewmat[:3, :3].T @ v.viewmat[:3, 3] for v in capture.views])
        normalization = Normalization.of(eyes, xyz)
        object_ids = np.unique(np.concatenate([[0], point_ids])).astype(np.int64)
        scene_xyz = normalization.to_scene(xyz)
        voxel = settings.voxel * normalization.scale if settings.voxel else median_spacing(scene_xyz)
        classes = np.searchsorted(object_ids, point_ids)
        anchors = seed_anchors(scene_xyz, capture.points.rgb / 255.0, classes, voxel, settings.layout, rng)
        generator = torch.Generator().manual_seed(settings.seed)
        heads = Heads(settings.layout, settings.mode, settings.sh_degree, generator)
        grey = {"learned": 0.5, "black": 0.0, "white": 1.0}[settings.background]
        model = ObjectModel(anchors, heads, torch.full((3,), grey), object_ids, normalization, settings.primitive)
        rest = capture.has_masks and bool((np.asarray(point_ids) == 0).mean() >= REST_FROM)
        scene = Scene(capture, object_ids, normalization, settings.zero_is_object, memory_mb, teach_unlabelled=rest)
        return cls(scene, settings, model, rng)

    # --- state on disk -------------------------------------------------------------------------------------------

    def save(self, folder: Path) -> None:
        """Write everything that the next step depends on."""
        model, anchors, s = self.model, self.model.anchors, self._statistics
        tensors = {
            "anchors.positions": anchors.positions,
            "anchors.rows": anchors.rows,
            "anchors.ids": anchors.ids,
            "adam.first": self._first,
            "adam.second": self._second,
            "growth.gradient": s.gradient,
            "growth.visits": s.visits,
            "growth.opacity": s.opacity,
            "growth.views": s.views,
            "object_ids": model.object_ids,
            "background": model.background.detach().numpy(),
        }
        for name, value in model.heads.state_dict().items():
            tensors[f"heads.{name}"] = value.numpy()
        for i, state in self._head_optimizer.state_dict()["state"].items():
            for name in ("step", "exp_avg", "exp_avg_sq"):
                tensors[f"head_adam.{i}.{name}"] = state[name].numpy()
        p = self.progress
        save_checkpoint(
            folder,
            tensors,
            {
                "settings": self.settings.as_dict(),
                "voxel": anchors.voxel,
                "teach_unlabelled": self.scene.teach_unlabelled,
                "normalization": {"centre": model.normalization.centre, "scale": model.normalization.scale},
                "rng": self.rng.bit_generator.state,
                "progress": {**p.__dict__},
            },
        )

    @classmethod
    def resume(
        cls, capture: Capture, folder: Path, settings: Settings | None = None, memory_mb: float = 2000
    ) -> tuple[Trainer, str | None] | None:
        """The trainer of the newest whole checkpoint in `folder` and a warning, or None if there is none.

        settings: what is asked for now; raises InputError if the checkpoint was made under others.
        """
        found = load_checkpoint(folder)
        if found is None:
            return None
        tensors, state, warning = found
        stored = Settings(**state["settings"])
        if settings is not None and settings != stored:
            changed = [k for k, v in settings.as_dict().items() if stored.as_dict()[k] != v]
            raise InputError(
                f"The checkpoint in {folder} was trained with other settings ({', '.join(changed)}); use the same, "
                "another --out, or --restart to train anew."
            )
        model = model_from_checkpoint(tensors, state)
        scene = Scene(
            capture, model.object_ids, model.normalization, stored.zero_is_object, memory_mb,
            teach_unlabelled=state["teach_unlabelled"],
        )  # fmt: skip
        rng = np.random.default_rng()
        rng.bit_generator.state = state["rng"]
        trainer = cls(scene, stored, model, rng)
        trainer._first, trainer._second = tensors["adam.first"].copy(), tensors["adam.second"].copy()
        trainer._statistics = GrowthStatistics(
            *(tensors[f"growth.{name}"].copy() for name in ("gradient", "visits", "opacity", "views"))
        )
        optimizer = trainer._head_optimizer
        saved = optimizer.state_dict()
        count = sum(len(group["params"]) for group in saved["param_groups"])
        saved["state"] = {
            i: {
                name: torch.from_numpy(tensors[f"head_adam.{i}.{name}"].copy())
                for name in ("step", "exp_avg", "exp_avg_sq")
            }
            for i in range(count)
            if f"head_adam.{i}.step" in tensors
        }
        optimizer.load_state_dict(saved)
        trainer.progress = Progress(**state["progress"])
        return trainer, warning

    # --- the loop ------------------------------------------------------------------------------------------------

    def run(
        self,
        budget: Budget,
        checkpoints: Path,
        reporter: Reporter,
        evaluate: Evaluate | None = None,
        stop: StopRequest | None = None,
        checkpoint_seconds: float = CHECKPOINT_SECONDS,
    ) -> None:
        """Train until the budget is spent. Raises Cancelled after saving when `stop` says so.

        A pause is no part of the training's time; a checkpoint is saved before it. Where a picture cannot be read or a
        file cannot be written, the steps until then are saved before the error goes on.
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
        p.evaluated = sum(1 for share in _EVALUATIONS if share <= budget.share(p.step, p.seconds))
        smooth = math.nan
        while True:
            p.seconds = before + time.monotonic() - started
            share = budget.share(p.step, p.seconds)
            if evaluate is not None and p.evaluated < len(_EVALUATIONS) and share >= _EVALUATIONS[p.evaluated]:
                self._evaluate(evaluate, reporter, share)
            if share >= 1.0:
                break
            if stop.paused:
                self.save(checkpoints)
                last_saved = time.monotonic()
            asked = time.monotonic()
            stopped = stop()
            waited = time.monotonic() - asked
            started, last_saved, last_report = started + waited, last_saved + waited, last_report + waited
            if stopped:
                self.save(checkpoints)
                raise Cancelled(f"Stopped after {p.step} steps; run the same command again to go on.")
            loss = self.step(share)
            smooth = loss if math.isnan(smooth) else 0.95 * smooth + 0.05 * loss
            now = time.monotonic()
            if now - last_report >= _REPORT_SECONDS:
                last_report = now
                p.seconds = before + now - started
                self._report(budget, reporter, smooth, (now - started) / (p.step - first_step))
            if now - last_saved >= checkpoint_seconds:
                self.save(checkpoints)
                last_saved = time.monotonic()
        self.save(checkpoints)
        if p.skipped:
            reporter.warning(f"{p.skipped} updates were not finite and were skipped.")

    def _evaluate(self, evaluate: Evaluate, reporter: Reporter, share: float) -> None:
        p = self.progress
        while p.evaluated < len(_EVALUATIONS) and _EVALUATIONS[p.evaluated] <= share:
            p.evaluated += 1
        quality = evaluate(self.model, self.scene)
        p.curve.append({"seconds": round(p.seconds, 2), "step": p.step, **quality})
        reporter.quality(**p.curve[-1])

    def _report(self, budget: Budget, reporter: Reporter, loss: float, pace: float) -> None:
        p = self.progress
        share = budget.share(p.step, p.seconds)
        latest = p.curve[-1] if p.curve else {}
        reporter.progress(
            round(share, 5),
            1.0,
            step=p.step,
            seconds=round(p.seconds, 1),
            seconds_left=round(budget.remaining(p.step, p.seconds, pace), 1),
            loss=round(loss, 5) if math.isfinite(loss) else None,
            anchors=len(self.model.anchors),
            splats=self.splats,
            psnr=latest.get("psnr"),
            miou=latest.get("miou"),
        )

    splats: int = 0
    """Splats drawn in the latest step."""

    def step(self, share: float) -> float:
        """One view forward, backward and update; returns the loss. share: how much of the training is behind."""
        p, anchors, settings = self.progress, self.model.anchors, self.settings
        if not p.queue:
            p.queue = self.rng.permutation(self.scene.capture.train_indices).tolist()
        index = p.queue[-1]
        view = self.scene.capture.views[index]
        downscale = downscale_at(share, max(view.width, view.height))
        picture, labels = self.scene.target(index, downscale)
        # Only now, so that a picture that cannot be read stays the next one.
        p.queue.pop()
        camera = self.scene.camera(index, downscale)
        viewmat, intrinsics = camera.arrays()
        seen = anchors_in_view(anchors, viewmat, intrinsics, camera.width, camera.height, camera.near)
        p.step += 1
        if len(seen) == 0:
            return math.nan

        rows = torch.from_numpy(take_rows(anchors.rows, seen)).requires_grad_()
        g = generate(
            anchors.layout, torch.from_numpy(anchors.positions[seen]), rows, torch.from_numpy(anchors.ids[seen]),
            self.model.heads, camera.centre,
        )  # fmt: skip
        self.splats = len(g.source)
        flat = settings.primitive == "2d"
        normal_weight, distortion_weight = (
            weight if flat and share >= SURFACE_FROM else 0.0
            for weight in (settings.normal_weight, settings.distortion_weight)
        )
        drawn = rasterize(
            *g[:6], camera, labels=labels if settings.semantic_weight else None, primitive=settings.primitive,
            want_depth=normal_weight > 0, want_normals=normal_weight > 0, want_distortion=distortion_weight > 0,
        )  # fmt: skip
        loss = image_loss(
            drawn.color, drawn.alpha, drawn.weight, self.model.background, picture, labels,
            settings.ssim_weight, settings.semantic_weight,
        )  # fmt: skip
        if settings.volume_weight and len(g.scales):
            loss = loss + settings.volume_weight * (0.5 if flat else 1.0) * volume_loss(g.scales, flat)
        if drawn.normals is not None and drawn.depth is not None:
            loss = loss + normal_weight * normal_loss(drawn.normals, drawn.depth, drawn.alpha, intrinsics)
        if drawn.distortion is not None:
            loss = loss + distortion_weight * drawn.distortion.mean()
        value = float(loss.detach())
        if not math.isfinite(value):
            p.skipped += 1
            return value
        self._head_optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self._update(seen, rows, share)
        if GROW_FROM / 2 <= share < GROW_UNTIL:
            self._grow(seen, g.source.numpy(), g.opacities.detach().numpy(), drawn, share)
        return value

    def _update(self, seen: np.ndarray, rows: torch.Tensor, share: float) -> None:
        step = self.progress.step
        for group in self._head_optimizer.param_groups:
            group["lr"] = rate(HEAD_RATES[group["name"]], share)
        heads = [parameter for group in self._head_optimizer.param_groups for parameter in group["params"]]
        if all(parameter.grad is None or bool(torch.isfinite(parameter.grad).all()) for parameter in heads):
            self._head_optimizer.step()
        else:
            self.progress.skipped += 1
        assert rows.grad is not None
        self.progress.skipped += int(
            step_rows(
                self.model.anchors.rows, self._first, self._second, seen, rows.grad.numpy(),
                row_rates(self.settings.layout, share), 1 - BETA1**step, 1 - BETA2**step,
            )
        )  # fmt: skip

    def _grow(self, seen: np.ndarray, source: np.ndarray, opacities: np.ndarray, drawn: Rendered, share: float) -> None:
        p, anchors = self.progress, self.model.anchors
        frame = drawn.frame
        if frame.screen_gradient is not None:
            self._statistics.add(
                seen, anchors.layout.offsets, source, opacities, frame.seen, frame.screen_gradient,
                frame.camera.width, frame.camera.height,
            )  # fmt: skip
        if share < GROW_FROM or p.step - p.last_growth < GROW_EVERY:
            return
        p.last_growth = p.step
        growth = grow_and_prune(
            anchors, self._statistics, GROW_EVERY // 5, self.rng, max_anchors=self.settings.max_anchors
        )

        def follow(moments: np.ndarray) -> np.ndarray:
            fresh = np.zeros((growth.added, moments.shape[1]), np.float32)
            return np.concatenate([moments[growth.kept], fresh])

        self._first, self._second = follow(self._first), follow(self._second)
        self._statistics = GrowthStatistics.zeros(len(anchors), anchors.layout.offsets)


def model_from_checkpoint(tensors: dict[str, np.ndarray], state: dict[str, Any]) -> ObjectModel:
    """The model that `load_checkpoint` returned the tensors and state of."""
    settings = Settings(**state["settings"])
    anchors = Anchors(
        settings.layout, float(state["voxel"]), *(tensors[f"anchors.{n}"].copy() for n in ("positions", "rows", "ids"))
    )
    heads = Heads(settings.layout, settings.mode, settings.sh_degree, torch.Generator())
    heads.load_state_dict(
        {k.removeprefix("heads."): torch.from_numpy(v.copy()) for k, v in tensors.items() if k.startswith("heads.")}
    )
    centre, scale = state["normalization"]["centre"], state["normalization"]["scale"]
    normalization = Normalization((centre[0], centre[1], centre[2]), scale)
    return ObjectModel(
        anchors, heads, torch.from_numpy(tensors["background"].copy()), tensors["object_ids"], normalization,
        settings.primitive,
    )  # fmt: skip


def load_model(folder: Path) -> tuple[ObjectModel, dict[str, Any], str | None]:
    """The trained model of a checkpoint folder, its state, and a warning; raises InputError if there is none."""
    found = load_checkpoint(folder)
    if found is None:
        raise InputError(f"{folder} holds no checkpoint; train first.")
    tensors, state, warning = found
    return model_from_checkpoint(tensors, state), state, warning


def progress_of(state: dict[str, Any]) -> Progress:
    """The training's progress in a checkpoint's state."""
    return Progress(**json.loads(json.dumps(state["progress"])))
