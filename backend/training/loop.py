"""The training loop: one view a step, growth now and then, checkpoints, a curve of held-out quality over time.

The model, its moments and the pictures lie on one device, the processor or a GPU, and so does a step: on a GPU the
processor only says what is to be done and does not wait for numbers, which it reads when it reports or saves.
"""

from __future__ import annotations

import itertools
import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from .. import device
from ..model.anchors import Anchors, median_spacing, seed_anchors
from ..model.checkpoint import load_checkpoint, save_checkpoint
from ..model.generate import Generated, generate
from ..model.growth import GrowthStatistics, grow_and_prune
from ..model.heads import Heads
from ..model.object_model import Normalization, ObjectModel, anchors_in_view, first_anchors_in_view
from ..protocol import Cancelled, InputError, Reporter
from ..raster import Camera, Rendered, rasterize
from ..stopping import StopRequest
from . import faults
from .adam import BETA1, BETA2, step_rows, take_rows
from .average import Average
from .budget import Budget, Progress
from .losses import image_loss, normal_loss, volume_loss
from .scene import Scene
from .settings import (
    GROW_FROM,
    GROW_UNTIL,
    HEAD_RATES,
    SURFACE_FROM,
    Settings,
    downscale_at,
    growth_interval,
    rate,
    rest_is_taught,
    row_rates,
)

if TYPE_CHECKING:
    from ..capture import Capture

CHECKPOINT_SECONDS = 30.0
_REPORT_SECONDS = 0.5

MOST_PARTS = 16
"""A picture that does not fit into the GPU's memory is drawn in so many parts at most."""

_IN_PARTS = (
    "The GPU's memory is full, so each picture is learned in {parts} parts from here on, and fewer pictures are kept "
    "there; a smaller --max-size or --max-anchors would be faster."
)
_FLAT = "More steps no longer make it much better: the rates fall now, from step {steps:,} on"
_NO_ROOM = (
    "The GPU's memory is too small, even for a sixteenth of a picture at a time; close programs that use it, or try a "
    "smaller --max-size or --max-anchors, or --device cpu."
)

_PICTURE = "the picture's loss"

Evaluate = Callable[[ObjectModel, Scene, Progress], dict[str, Any]]


class _Part(NamedTuple):
    """A picture, or a strip of one: its camera, picture (3, h, w), labels (h, w), the share of the picture's pixels
    that it has, and by how much more of its pixels are labelled than of the whole picture's."""

    camera: Camera
    picture: torch.Tensor
    labels: torch.Tensor | None
    share: float
    more_labels: float | torch.Tensor


class _Shown(NamedTuple):
    """What growth needs to know of a drawn part: its anchors (n,), the `source` (S,) of its splats and their opacities
    (S,), which of them met the picture (S,), and their gradient on the screen (S, 2)."""

    anchors: torch.Tensor
    source: torch.Tensor
    opacities: torch.Tensor
    met: torch.Tensor | np.ndarray
    screen_gradient: torch.Tensor | np.ndarray

    @classmethod
    def together(cls, parts: Sequence[_Shown], offsets: int) -> _Shown:
        """The parts of a picture as one, on the GPU: a splat that several of them show is met once, and its gradient is
        the sum of theirs."""
        anchors = torch.cat([part.anchors for part in parts]).unique()
        opacities = parts[0].opacities.new_zeros((len(anchors), offsets))
        met, gradient = torch.zeros_like(opacities, dtype=torch.bool), opacities.new_zeros((len(anchors), offsets, 2))
        for part in parts:
            place = torch.searchsorted(anchors, part.anchors)
            opacities[place] = part.opacities.view(-1, offsets)
            met[place] |= torch.as_tensor(part.met).view(-1, offsets)
            gradient[place] += torch.as_tensor(part.screen_gradient).view(-1, offsets, 2)
        source = torch.arange(met.numel(), device=met.device)
        return cls(anchors, source, opacities.flatten(), met.flatten(), gradient.view(-1, 2))


class _Learned(NamedTuple):
    """One view's loss () and gradients: in `rows` (n, columns), copies of those of the anchors `seen` (n,), and in the
    heads. On the GPU, sound () bool: whether anything may come of them, and usable (n,) bool: of which rows."""

    camera: Camera
    loss: torch.Tensor
    seen: torch.Tensor
    rows: torch.Tensor
    sound: torch.Tensor | None
    usable: torch.Tensor | None
    shown: list[_Shown]


class _Limits:
    """How many anchors to take for a view without waiting for their number: somewhat more than it had in sight last
    time, which the GPU has reported since. All, for a view that is new."""

    _MARGIN, _STEP = 1.25, 4096

    def __init__(self) -> None:
        self._reports: dict[int, tuple[torch.Tensor, torch.cuda.Event | None, int]] = {}

    def of(self, view: int, anchors: int) -> int:
        """The limit for a view where there are so many anchors in all."""
        if view not in self._reports:
            return anchors
        count, arrived, then = self._reports[view]
        if arrived is not None and not arrived.query():
            return anchors
        expected = int(count) * anchors / max(then, 1)
        return min(anchors, math.ceil(self._MARGIN * expected / self._STEP + 1) * self._STEP)

    def note(self, view: int, count: torch.Tensor, anchors: int) -> None:
        """The view has `count` () of so many anchors in sight."""
        if not count.is_cuda:
            self._reports[view] = (count, None, anchors)
            return
        report = torch.empty((), dtype=count.dtype, pin_memory=True).copy_(count, non_blocking=True)
        arrived = torch.cuda.Event()
        arrived.record()
        self._reports[view] = (report, arrived, anchors)


def strips(
    camera: Camera, picture: torch.Tensor, labels: torch.Tensor | None, count: int
) -> list[tuple[Camera, torch.Tensor, torch.Tensor | None]]:
    """The picture (3, H, W), its labels (H, W) and its camera in `count` strips across its longer side."""
    wide = camera.width >= camera.height
    length = camera.width if wide else camera.height
    edges = [round(i * length / count) for i in range(count + 1)]
    found = []
    for first, last in itertools.pairwise(sorted(set(edges))):
        part = (slice(None), slice(first, last)) if wide else (slice(first, last), slice(None))
        size = last - first
        crop = camera.crop(first, 0, size, camera.height) if wide else camera.crop(0, first, camera.width, size)
        found.append((crop, picture[:, *part].contiguous(), None if labels is None else labels[part].contiguous()))
    return found


class Trainer:
    """One model in training, on the device where it lies. Create with `start` or `resume`, then `run`."""

    def __init__(self, scene: Scene, settings: Settings, model: ObjectModel, rng: np.random.Generator) -> None:
        self.scene = scene
        self.settings = settings
        self.model = model
        self.rng = rng
        self.progress = Progress()
        anchors = model.anchors
        self.parts = 1
        self._first = torch.zeros_like(anchors.rows)
        self._second = torch.zeros_like(anchors.rows)
        self._statistics = GrowthStatistics.zeros(len(anchors), anchors.layout.offsets, model.device)
        self._limits = _Limits()
        self._skipped = torch.zeros((), dtype=torch.int64, device=model.device)
        self._noticed = 0
        self._closely = False
        self._fault: faults.Fault | None = None
        self._to_say: list[str] = []
        self._splats: int | torch.Tensor = 0
        self._average = Average(model)
        model.background.requires_grad_(settings.background == "learned")
        groups: list[dict[str, Any]] = [
            {"params": list(getattr(model.heads, name).parameters()), "name": name, "lr": ends[0]}
            for name, ends in HEAD_RATES.items()
            if name != "background"
        ]
        groups.append({"params": [model.background], "name": "background", "lr": HEAD_RATES["background"][0]})
        self._head_optimizer = torch.optim.Adam(groups, betas=(BETA1, BETA2), eps=1e-15, fused=True)

    @classmethod
    def start(
        cls,
        capture: Capture,
        point_ids: np.ndarray,
        settings: Settings,
        memory_mb: float = 2000,
        place: torch.device = device.CPU,
        *,
        seeds: np.ndarray | None = None,
        teach_unlabelled: bool | None = None,
        gains: np.ndarray | None = None,
    ) -> Trainer:
        """A fresh model on the capture's points, whose objects are point_ids ((M,) int64), on the device `place`.

        seeds (M,) bool: the points that anchors start from (None: all), which alone say how large the scene is and how
        dense; teach_unlabelled, gains: as `Scene` has them, None: as the points and photos say.
        """
        rng = np.random.default_rng(settings.seed)
        seeds = np.ones(len(capture.points.xyz), np.bool_) if seeds is None else seeds
        xyz, rgb = capture.points.xyz[seeds], capture.points.rgb[seeds]
        eyes = np.array([-v.viewmat[:3, :3].T @ v.viewmat[:3, 3] for v in capture.views])
        normalization = Normalization.of(eyes, xyz)
        object_ids = np.unique(np.concatenate([[0], point_ids])).astype(np.int64)
        scene_xyz = normalization.to_scene(xyz)
        voxel = settings.voxel * normalization.scale if settings.voxel else median_spacing(scene_xyz)
        classes = np.searchsorted(object_ids, point_ids[seeds])
        anchors = seed_anchors(scene_xyz, rgb / 255.0, classes, voxel, settings.layout, rng)
        generator = torch.Generator().manual_seed(settings.seed)
        heads = Heads(settings.layout, settings.mode, settings.sh_degree, generator)
        shade = {"learned": rgb.mean(axis=0) / 255.0, "black": np.zeros(3), "white": np.ones(3)}
        background = torch.from_numpy(shade[settings.background].astype(np.float32))
        model = ObjectModel(anchors, heads, background, object_ids, normalization, settings.primitive)
        if teach_unlabelled is None:
            teach_unlabelled = capture.has_masks and rest_is_taught(point_ids[seeds])
        scene = Scene(
            capture, object_ids, normalization, settings.zero_is_object, memory_mb, teach_unlabelled, place, gains
        )
        return cls(scene, settings, model.to(place), rng)

    @property
    def shown(self) -> ObjectModel:
        """What the training has come to: the mean over its latest steps."""
        return self._average.of(self.model)

    # --- state on disk -------------------------------------------------------------------------------------------

    def save(self, folder: Path) -> None:
        """Write everything that the next step depends on."""
        model, anchors, s = self.model, self.model.anchors, self._statistics
        self.progress.skipped += int(self._skipped)
        self._skipped.zero_()
        self._noticed = 0
        tensors: dict[str, torch.Tensor | np.ndarray] = {
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
            "background": model.background,
            **self._average.tensors(),
        }
        for name, value in model.heads.state_dict().items():
            tensors[f"heads.{name}"] = value
        for i, state in self._head_optimizer.state_dict()["state"].items():
            for name in ("step", "exp_avg", "exp_avg_sq"):
                tensors[f"head_adam.{i}.{name}"] = state[name]
        p = self.progress
        save_checkpoint(
            folder,
            {name: device.host(value) for name, value in tensors.items()},
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
        cls,
        capture: Capture,
        folder: Path,
        settings: Settings | None = None,
        memory_mb: float = 2000,
        place: torch.device = device.CPU,
        gains: np.ndarray | None = None,
    ) -> tuple[Trainer, str | None] | None:
        """The trainer of the newest whole checkpoint in `folder` and a warning, or None if there is none.

        Training continues on the device `place`, whichever it was saved on. settings: what is asked for now; raises
        InputError if the checkpoint was made under others.
        """
        found = load_checkpoint(folder)
        if found is None:
            return None
        tensors, state, warning = found
        stored = Settings(**state["settings"])
        if settings is not None and settings.in_effect() != stored.in_effect():
            changed = [k for k, v in settings.as_dict().items() if stored.as_dict()[k] != v]
            raise InputError(
                f"The checkpoint in {folder} was trained with other settings ({', '.join(changed)}); use the same, "
                "another --out, or --restart to train anew."
            )
        model = model_from_checkpoint(tensors, state)
        scene = Scene(
            capture, model.object_ids, model.normalization, stored.zero_is_object, memory_mb,
            state["teach_unlabelled"], place, gains,
        )  # fmt: skip
        rng = np.random.default_rng()
        rng.bit_generator.state = state["rng"]
        trainer = cls(scene, stored, model.to(place), rng)

        def there(name: str) -> torch.Tensor:
            return torch.from_numpy(tensors[name].copy()).to(place)

        trainer._first, trainer._second = there("adam.first"), there("adam.second")
        trainer._statistics = GrowthStatistics(
            *(there(f"growth.{name}") for name in ("gradient", "visits", "opacity", "views"))
        )
        optimizer = trainer._head_optimizer
        saved = optimizer.state_dict()
        count = sum(len(group["params"]) for group in saved["param_groups"])
        saved["state"] = {
            i: {name: there(f"head_adam.{i}.{name}") for name in ("step", "exp_avg", "exp_avg_sq")}
            for i in range(count)
            if f"head_adam.{i}.step" in tensors
        }
        optimizer.load_state_dict(saved)
        trainer._average = Average.of_checkpoint(tensors, trainer.model)
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
        budget.begin(p)
        smooth = torch.full((), math.nan, device=self.model.device)
        parts = self.parts
        while True:
            p.seconds = before + time.monotonic() - started
            if evaluate is not None and budget.evaluation_is_due(p):
                self._evaluate(evaluate, reporter, float(smooth))
                if budget.settle(p):
                    reporter.status(_FLAT.format(steps=p.step))
            share = budget.share(p)
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
            while self._to_say:
                reporter.warning(self._to_say.pop(0))
            smooth = torch.where(smooth.isnan(), loss, smooth.lerp(loss, 0.05))
            if parts == 1 < self.parts:
                reporter.warning(_IN_PARTS.format(parts=self.parts))
                parts = self.parts
            now = time.monotonic()
            if now - last_report >= _REPORT_SECONDS:
                last_report = now
                p.seconds = before + now - started
                self._report(budget, reporter, float(smooth), (now - started) / (p.step - first_step))
                self._look_out()
            if now - last_saved >= checkpoint_seconds:
                self.save(checkpoints)
                last_saved = time.monotonic()
        self.save(checkpoints)
        if p.skipped:
            because = f": {p.causes}" if p.faults else ""
            reporter.warning(f"{p.skipped} updates were not finite and were skipped{because}.")

    def _evaluate(self, evaluate: Evaluate, reporter: Reporter, loss: float) -> None:
        p = self.progress
        quality = evaluate(self.shown, self.scene, p)
        loss_db = round(-20 * math.log10(loss), 3) if 0 < loss < math.inf else None
        came_to = {"seconds": round(p.seconds, 2), "step": p.step, "anchors": len(self.model.anchors)}
        p.curve.append({**came_to, "loss_db": loss_db, **quality})
        reporter.quality(**p.curve[-1])

    def _report(self, budget: Budget, reporter: Reporter, loss: float, pace: float) -> None:
        p = self.progress
        left = budget.remaining(p, pace)
        latest = p.curve[-1] if p.curve else {}
        reporter.progress(
            round(budget.behind(p), 5),
            1.0,
            step=p.step,
            seconds=round(p.seconds, 1),
            seconds_left=None if left is None else round(left, 1),
            loss=round(loss, 5) if math.isfinite(loss) else None,
            anchors=len(self.model.anchors),
            splats=self.splats,
            psnr=latest.get("psnr"),
            miou=latest.get("miou"),
        )

    @property
    def splats(self) -> int:
        """Splats drawn in the latest step."""
        return int(self._splats)

    def step(self, share: float) -> torch.Tensor:
        """One view forward, backward and update; returns the loss, () float32, NaN where nothing came of it.

        share: how much of the training is behind. Where the GPU's memory does not do, the view is learned again in
        more parts (`parts`).
        """
        p = self.progress
        if not p.queue:
            p.queue = self.rng.permutation(self.scene.capture.train_indices).tolist()
        learned, full = self._learn_if_it_fits(p.queue[-1], share)
        while full:
            self._make_room()
            learned, full = self._learn_if_it_fits(p.queue[-1], share)
        # Only now, so that a picture that cannot be read stays the next one.
        index = p.queue.pop()
        p.step += 1
        loss = torch.full((), math.nan, device=self.model.device)
        if learned is not None:
            self._update(learned, share)
            self._average.follow(self.model, p.step)
            loss = learned.loss if learned.sound is None else torch.where(learned.sound, learned.loss, loss)
        before = len(self.model.anchors)
        if self._fault is not None:
            self._settle(self._fault, index)
        if learned is not None and GROW_FROM / 2 <= share < GROW_UNTIL and len(self.model.anchors) == before:
            self._grow(learned, share)
        return loss

    def _settle(self, fault: faults.Fault, index: int) -> None:
        """Count a fault that the step on view `index` met, prepare a sentence if it is the first of its kind, and take
        hopeless anchors out."""
        self._fault = None
        p, model, capture = self.progress, self.model, self.scene.capture
        if fault.what not in p.faults:
            owner = None
            if len(fault.anchors):
                object_id = int(model.object_ids[int(model.anchors.ids[fault.anchors[0]])])
                owner = capture.names.get(object_id, f"object {object_id}" if object_id else "no object")
            self._to_say.append(fault.sentence(p.step, capture.views[index].name, owner))
        p.faults[fault.what] = p.faults.get(fault.what, 0) + 1
        if not len(fault.hopeless):
            return
        a = model.anchors
        kept = torch.ones(len(a), dtype=torch.bool, device=model.device)
        kept[fault.hopeless] = False
        a.positions, a.rows, a.ids = a.positions[kept], a.rows[kept], a.ids[kept]
        self._first, self._second = self._first[kept], self._second[kept]
        self._average.take(kept, a.rows[:0])
        self._statistics = GrowthStatistics.zeros(len(a), a.layout.offsets, model.device)

    def _look_out(self) -> None:
        """On the GPU, where no step waits for its numbers: look closely from now on, while updates are skipped."""
        skipped = int(self._skipped)
        self._closely, self._noticed = skipped > self._noticed, skipped

    def _learn_if_it_fits(self, index: int, share: float) -> tuple[_Learned | None, bool]:
        """What `_learn` finds, and whether the GPU's memory was full instead."""
        try:
            return self._learn(index, share), False
        except Exception as error:
            if not device.is_out_of_memory(error):
                raise
            return None, True

    def _make_room(self) -> None:
        """Prepare for the same view again, at a lower cost in memory."""
        if self.parts >= MOST_PARTS:
            raise InputError(_NO_ROOM)
        self.parts *= 2
        self._head_optimizer.zero_grad(set_to_none=True)
        self.scene.forget(shrink=0.5)
        if self.model.device.type == "cuda":
            torch.cuda.empty_cache()

    def _learn(self, index: int, share: float) -> _Learned | None:
        """The loss of view `index` and its gradients; None where the view shows nothing or, where one looks closely,
        the loss is not finite."""
        anchors, on_gpu = self.model.anchors, device.on_gpu(self.model.anchors.rows)
        view = self.scene.capture.views[index]
        downscale = downscale_at(share, max(view.width, view.height), self.settings.pyramid)
        picture, labels = self.scene.target(index, downscale)
        camera = self.scene.camera(index, downscale)
        present = None
        if on_gpu and self.parts == 1:
            limit = self._limits.of(index, len(anchors))
            seen, present, count = first_anchors_in_view(anchors, *_frustum(camera), limit)
            self._limits.note(index, count, len(anchors))
        else:
            seen = anchors_in_view(anchors, *_frustum(camera))
        if len(seen) == 0:
            return None
        self._head_optimizer.zero_grad(set_to_none=True)
        rows = take_rows(anchors.rows, seen).requires_grad_()
        loss = torch.zeros((), device=rows.device)
        self._splats = 0
        shown = []
        for part in self._parts_of(camera, picture, labels):
            chosen = self._chosen(part, seen, rows)
            terms, g, drawn = self._terms(part, *chosen, present, share)
            of_part = self._sum(terms, part)
            if self._looks_closely and not math.isfinite(float(of_part.detach())):
                self._skipped += 1
                named = self._apart(terms, part, drawn)
                self._fault = faults.of_loss(named, g, chosen[0], anchors.layout.offsets)
                return None
            of_part.backward()
            loss = loss + of_part.detach()
            self._splats = self._splats + (len(g.source) if g.made is None else g.made.sum())
            if GROW_FROM / 2 <= share < GROW_UNTIL and drawn.frame.screen_gradient is not None:
                shown.append(
                    _Shown(chosen[0], g.source, g.opacities.detach(), drawn.frame.seen, drawn.frame.screen_gradient)
                )
        sound = usable = None
        if on_gpu:
            sound = loss.isfinite() if present is None else loss.isfinite() & present.any()
            usable = sound.expand(len(seen)) if present is None else sound & present
        return _Learned(camera, loss, seen, rows, sound, usable, shown)

    def _parts_of(self, camera: Camera, picture: torch.Tensor, labels: torch.Tensor | None) -> Iterator[_Part]:
        """What to draw at a time. The parts' losses add up to the picture's, but for SSIM beside the cuts."""
        if self.parts == 1:
            yield _Part(camera, picture, labels, 1.0, 1.0)
            return
        for crop, cut, cut_labels in strips(camera, picture, labels, self.parts):
            share = crop.width * crop.height / (camera.width * camera.height)
            more: float | torch.Tensor = 1.0
            if labels is not None and cut_labels is not None:
                more = (cut_labels >= 0).sum() / ((labels >= 0).sum().clamp(min=1) * share)
            yield _Part(crop, cut, cut_labels, share, more)

    def _chosen(self, part: _Part, seen: torch.Tensor, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The anchors and rows that a part is drawn from, of those of the whole picture."""
        if self.parts == 1:
            return seen, rows
        a = self.model.anchors
        here = anchors_in_view(
            Anchors(a.layout, a.voxel, a.positions[seen], rows.detach(), a.ids[seen]), *_frustum(part.camera)
        )
        return seen[here], rows.index_select(0, here)

    @property
    def _looks_closely(self) -> bool:
        """Whether each step's numbers are looked at before the next: always where that costs no wait."""
        return self._closely or not device.on_gpu(self.model.anchors.rows)

    def _terms(
        self, part: _Part, seen: torch.Tensor, rows: torch.Tensor, present: torch.Tensor | None, share: float
    ) -> tuple[dict[str, torch.Tensor], Generated, Rendered]:
        """The terms of a part's loss, each () and weighted, and what was drawn for it from the anchors' rows."""
        anchors, settings = self.model.anchors, self.settings
        g = generate(
            anchors.layout, anchors.positions[seen], rows, anchors.ids[seen], self.model.heads, part.camera.centre,
            present,
        )  # fmt: skip
        flat = settings.primitive == "2d"
        normal_weight, distortion_weight = (
            weight if flat and share >= SURFACE_FROM else 0.0
            for weight in (settings.normal_weight, settings.distortion_weight)
        )
        drawn = rasterize(
            *g[:6], part.camera, labels=part.labels if settings.semantic_weight else None,
            primitive=settings.primitive, want_depth=normal_weight > 0, want_normals=normal_weight > 0,
            want_distortion=distortion_weight > 0,
        )  # fmt: skip
        terms = {_PICTURE: self._image_loss(part, drawn, drawn.weight)}
        if settings.volume_weight and len(g.scales):
            terms["the volume loss"] = (
                settings.volume_weight * (0.5 if flat else 1.0) * volume_loss(g.scales, flat, g.made)
            )
        if drawn.normals is not None and drawn.depth is not None:
            intrinsics = part.camera.arrays()[1]
            terms["the normal loss"] = normal_weight * normal_loss(drawn.normals, drawn.depth, drawn.alpha, intrinsics)
        if drawn.distortion is not None:
            terms["the distortion loss"] = distortion_weight * drawn.distortion.mean()
        return terms, g, drawn

    def _image_loss(self, part: _Part, drawn: Rendered, weight: torch.Tensor | None) -> torch.Tensor:
        """The loss () of the picture, and where there is a weight of the labels."""
        return image_loss(
            drawn.color, drawn.alpha, weight, self.model.background, part.picture, part.labels,
            self.settings.ssim_weight, self.settings.semantic_weight * part.more_labels,
        )  # fmt: skip

    def _sum(self, terms: dict[str, torch.Tensor], part: _Part) -> torch.Tensor:
        """The loss of a part, weighted by its size."""
        first, *others = terms.values()
        loss = sum(others, start=first)
        return part.share * loss if self.parts > 1 else loss

    def _apart(self, terms: dict[str, torch.Tensor], part: _Part, drawn: Rendered) -> dict[str, torch.Tensor]:
        """The same terms, those of the picture and of the labels by themselves."""
        with torch.no_grad():
            picture = self._image_loss(part, drawn, None)
        labels = torch.where(picture.isfinite(), terms[_PICTURE].detach(), 0.0)
        return {**terms, _PICTURE: picture, "the label loss": labels}

    def _update(self, learned: _Learned, share: float) -> None:
        step, optimizer = self.progress.step, self._head_optimizer
        for group in optimizer.param_groups:
            group["lr"] = rate(HEAD_RATES[group["name"]], share)
        gradients = {
            group["name"]: [parameter.grad.flatten() for parameter in group["params"] if parameter.grad is not None]
            for group in optimizer.param_groups
        }
        sound = torch.cat([part for parts in gradients.values() for part in parts]).isfinite().all()
        if learned.sound is not None:
            sound = sound & learned.sound
        # As torch's gradient scaler does it: the optimiser looks at this on the device and leaves everything as it is.
        optimizer.found_inf = (~sound).float()  # type: ignore[attr-defined]
        optimizer.step()
        assert learned.rows.grad is not None
        skipped = ~sound + step_rows(
            self.model.anchors.rows, self._first, self._second, learned.seen, learned.rows.grad,
            row_rates(self.settings.layout, share), 1 - BETA1**step, 1 - BETA2**step, learned.usable,
        )  # fmt: skip
        self._skipped += skipped
        if self._looks_closely and skipped:
            self._fault = faults.of_rows(
                learned.rows.grad, learned.rows.detach(), learned.seen, self.settings.layout
            ) or faults.of_heads(gradients)

    def _grow(self, learned: _Learned, share: float) -> None:
        p, anchors, camera = self.progress, self.model.anchors, learned.camera
        if learned.shown:
            whole = len(learned.shown) == 1
            shown = learned.shown[0] if whole else _Shown.together(learned.shown, anchors.layout.offsets)
            self._statistics.add(
                shown.anchors, anchors.layout.offsets, shown.source, shown.opacities, shown.met, shown.screen_gradient,
                camera.width, camera.height, learned.usable if whole else None,
            )  # fmt: skip
        if share < GROW_FROM or p.step - p.last_growth < growth_interval(p.step):
            return
        p.last_growth = p.step
        growth = grow_and_prune(anchors, self._statistics, self.rng, max_anchors=self.settings.max_anchors)

        def follow(moments: torch.Tensor) -> torch.Tensor:
            return torch.cat([moments[growth.kept], moments.new_zeros((growth.added, moments.shape[1]))])

        self._first, self._second = follow(self._first), follow(self._second)
        self._average.take(growth.kept, anchors.rows[len(anchors) - growth.added :])
        self._statistics = self._statistics.after(growth, anchors.layout.offsets)


def _frustum(camera: Camera) -> tuple[np.ndarray, np.ndarray, int, int, float]:
    """What `anchors_in_view` asks for."""
    return (*camera.arrays(), camera.width, camera.height, camera.near)


def model_from_checkpoint(tensors: dict[str, np.ndarray], state: dict[str, Any]) -> ObjectModel:
    """The model that `load_checkpoint` returned the tensors and state of."""
    settings = Settings(**state["settings"])
    anchors = Anchors(
        settings.layout, float(state["voxel"]),
        *(torch.from_numpy(tensors[f"anchors.{n}"].copy()) for n in ("positions", "rows", "ids")),
    )  # fmt: skip
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


def load_model(folder: Path, place: torch.device = device.CPU) -> tuple[ObjectModel, dict[str, Any], str | None]:
    """What the training of a checkpoint folder has come to, on the device `place`, its state, and a warning; raises
    InputError if there is none."""
    found = load_checkpoint(folder)
    if found is None:
        raise InputError(f"{folder} holds no checkpoint; train first.")
    tensors, state, warning = found
    model = model_from_checkpoint(tensors, state)
    return Average.of_checkpoint(tensors, model).of(model).to(place), state, warning


def progress_of(state: dict[str, Any]) -> Progress:
    """The training's progress in a checkpoint's state."""
    return Progress(**json.loads(json.dumps(state["progress"])))
