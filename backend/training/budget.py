"""Length of a training: a number of steps, a time, or until convergence."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..shared.expectation import PRESET_STEPS
from .settings import GROW_UNTIL, PLATEAU_FROM, PLATEAU_UNTIL

_EVALUATIONS = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 1.0)
"""Progress values at which a training of known length is evaluated."""

_EVALUATE_AFTER, _EVALUATE_EARLY, _EVALUATE_EVERY = 100, 1.3, 1.08
"""A training until convergence is evaluated for the first time after this number of steps, then whenever the number of
steps has grown by a factor: the first one during the warm-up, the second one later, when evaluations decide on the
end."""

WARM_UP = 600
"""Number of steps until the plateau of a training until convergence; the scene's size only affects the length of the
plateau. During the warm-up, the error decreases faster than later. Earlier growth would result in more anchors, but no
better quality."""

LOOKAHEAD, WORTHWHILE_DB, _WORTHWHILE_BEFORE = 1000, 0.2, 0.36
"""A training has converged when this number of further steps would gain less than this number of dB; the last number is
that of earlier versions."""

OCTAVES, MIN_OCTAVES = 2, 1.25
"""The gain of further steps is extrapolated from the evaluations in the latest octaves of steps (an octave doubles the
number of steps). Evaluations that span fewer octaves than the second number are too noisy for an extrapolation."""

GROWTH_OCTAVES, MIN_GROWTH = 0.5, 1.01
"""Growth ends when the number of anchors has grown by less than this factor over this number of octaves of steps; from
then on, growth would only move anchors, which takes time and disturbs the others."""

VALIDATE_EVERY, MAX_VALIDATION_VIEWS, MIN_TRAINED_VIEWS = 8, 20, 16
"""A training until convergence validates on every 8th training view, at most on this number. None is spared if fewer
than the third number of views would be left to train on: the few that could be would cost the model more than they
tell about it."""

_JOINED = ", joined"

DECAY_FROM, _DECAY_FROM_BEFORE = 0.8, 0.9
"""Fraction of its steps at which a training until convergence leaves the plateau of the learning rates; after that, it
trains on the validation views, too. The second number is that of checkpoints of earlier versions."""


@dataclass
class TrainingProgress:
    """The progress of a training; saved with each checkpoint.

    Attributes:
        last_growth: step from which the interval to the next growth is counted.
        skipped: number of updates that were not finite.
        faults: number of steps for each known cause of such updates.
        queue: remaining views of this pass over the training views.
        evaluated: for a training of known length, the number of evaluations so far; for a training until convergence,
            the step of the latest one.
        grown: whether growth has ended.
        plateau_at: step at which the plateau of a training until convergence began, or began again after a training of
            known length or an earlier decay; None for one of known length.
        converged_at: step at which the plateau ended and the learning rate decay began; 0 before.
        ends_at: step at which the decay ends; 0 before, and in checkpoints of earlier versions.
        limited: whether the time limit has ended the plateau, before the training has converged.
        curve: for each evaluation, the seconds, step, number of anchors, loss (dB) and measured quality, on held-out
            views unless they are left for later, as `validation_psnr` on validation views, and as `watched_psnr` on
            those of `watched`. `objective` tells apart losses that do not compare.
        joined: whether the validation views are trained on, too, after they have decided on the end.
        watched: training views that are spared, as `overfitting` describes.
        dropped: fraction of the splats that each step leaves out.
        smooth_loss: mean of the latest losses, as far as it is known; kept up to date when the training is saved.
    """

    step: int = 0
    seconds: float = 0.0
    last_growth: int = 0
    skipped: int = 0
    faults: dict[str, int] = field(default_factory=dict)
    queue: list[int] = field(default_factory=list)
    evaluated: int = 0
    grown: bool = False
    converged_at: int = 0
    curve: list[dict[str, Any]] = field(default_factory=list)
    watched: list[int] = field(default_factory=list)
    dropped: float = 0.0
    joined: bool = False
    ends_at: int = 0
    limited: bool = False
    plateau_at: int | None = None
    smooth_loss: float | None = None

    @property
    def latest(self) -> dict[str, Any]:
        """The latest entry of the curve with figures of held-out views, or an empty one."""
        return next((entry for entry in reversed(self.curve) if entry.get("psnr") is not None), {})

    def join(self, validation: Sequence[int]) -> bool:
        """Train on the validation views first, and on all views from then on; return whether there are such views."""
        if self.joined or not validation:
            return False
        self.joined = True
        self.queue += validation
        return True

    def joining(self, before: TrainingProgress, validation: Sequence[int]) -> list[int]:
        """Return the views that are trained on now, but were not at the progress `before`."""
        validated = validation if self.joined and not before.joined else ()
        return [*validated, *(() if self.watched else before.watched)]

    def leave(self) -> None:
        """Train without the validation views again, since they decide on the end."""
        if self.joined:
            self.joined, self.queue = False, []

    @property
    def causes(self) -> str:
        """Description of the faults and their numbers of steps, most frequent first."""
        by_count = sorted(self.faults.items(), key=lambda entry: -entry[1])
        return ", ".join(f"{what} ({count} {'step' if count == 1 else 'steps'})" for what, count in by_count)


@dataclass(frozen=True)
class Budget:
    """Total length of a training, in steps or seconds, which also determines the schedules.

    until_converged: train until further steps would gain little on the validation views; `seconds` is then a limit,
    None: no limit.
    first, first_step: progress at the start, for a model that was trained before, and with `steps` the number of its
        first step.
    """

    steps: int | None = None
    seconds: float | None = None
    until_converged: bool = False
    first: float = 0.0
    first_step: int = 0

    def progress(self, p: TrainingProgress) -> float:
        """Return the progress that determines learning rates, growth and resolution.

        Returns:
            0 .. 1. A training until convergence stays at a progress on the plateau until `check_convergence` ends it,
            first with growth, then without.
        """
        if self.until_converged:
            if not p.converged_at and p.step < WARM_UP:
                return PLATEAU_FROM * p.step / WARM_UP
            if not p.converged_at:
                return (GROW_UNTIL + (PLATEAU_UNTIL if p.grown else PLATEAU_FROM)) / 2
            decay = (p.step - p.converged_at) / (end_of_decay(p) - p.converged_at)
            limit = self._limit(p)
            if limit is not None:
                # Steps take longer from here on, where images are not reduced any more.
                begin = max(DECAY_FROM * limit, _seconds_at(p, p.converged_at))
                decay = max(decay, (p.seconds - begin) / (limit - begin))
            return min(PLATEAU_UNTIL + (1 - PLATEAU_UNTIL) * decay, 1.0)
        if self.steps is not None:
            done = (p.step - self.first_step) / max(self.steps - self.first_step, 1)
            return min(self.first + (1.0 - self.first) * done, 1.0)
        assert self.seconds is not None
        return min(self.first + (1.0 - self.first) * p.seconds / self.seconds, 1.0)

    def remaining(self, p: TrainingProgress, pace: float) -> float | None:
        """Estimate the remaining seconds.

        Args:
            p: the progress of the training.
            pace: seconds per step.

        Returns:
            The seconds; None as long as the end of a training until convergence cannot be estimated.
        """
        if self.until_converged:
            end, limit = expected_end(p), self._limit(p)
            left = [] if end is None else [max(end - p.step, 0) * pace]
            left += [] if limit is None else [max(limit - p.seconds, 0.0)]
            return min(left, default=None)
        if self.steps is not None:
            return max(self.steps - p.step, 0) * pace
        assert self.seconds is not None
        return max(self.seconds - p.seconds, 0.0)

    def displayed_progress(self, p: TrainingProgress) -> float:
        """Return the progress to display, 0 .. 1.

        For a training until convergence, this is the fraction of the expected number of steps; as long as there is no
        estimate, `LOOKAHEAD` further steps are expected.
        """
        progress = self.progress(p)
        if not self.until_converged or progress >= 1.0:
            return (progress - self.first) / (1.0 - self.first)
        end, limit = expected_end(p), self._limit(p)
        steps = p.step / (p.step + LOOKAHEAD if end is None else max(end, p.step + 1))
        return steps if limit is None else min(max(steps, p.seconds / limit), 1.0)

    def begin(self, p: TrainingProgress) -> None:
        """Initialize `p` for this budget; the training may have been started with a different one."""
        if self.until_converged:
            # Stops must not delay evaluations, which decide when the training ends.
            p.evaluated = int(p.curve[-1]["step"]) if p.curve else 0
            if p.converged_at and not p.ends_at:
                # Of an earlier version, which did not note why the plateau ended.
                before = convergence_step([e for e in p.curve if e["step"] <= p.converged_at], _WORTHWHILE_BEFORE)
                p.limited = bool(p.curve) and (before is None or p.converged_at < before)
            if p.limited and not self._is_limited(p):
                p.converged_at, p.ends_at, p.limited, p.plateau_at = 0, 0, False, None
            if not p.converged_at:
                p.leave()
                p.plateau_at = p.step if p.plateau_at is None else p.plateau_at
        else:
            p.plateau_at = None
            p.evaluated = bisect_right(_EVALUATIONS, self.progress(p))

    def evaluation_is_due(self, p: TrainingProgress) -> bool:
        """Return whether an evaluation is due, and mark it as done."""
        progress = self.progress(p)
        if self.until_converged:
            factor = _EVALUATE_EARLY if p.step < WARM_UP else _EVALUATE_EVERY
            due = p.step >= max(_EVALUATE_AFTER, factor * p.evaluated)
            due = due or self._out_of_time(p) or (progress >= 1.0 and p.step > p.evaluated)
            evaluated = p.step if due else p.evaluated
        else:
            evaluated = bisect_right(_EVALUATIONS, progress)
            due = evaluated > p.evaluated
        p.evaluated = evaluated
        return due

    def check_convergence(self, p: TrainingProgress) -> bool:
        """End growth if it has ceased, and end the plateau if the training has converged or the time limit requires it.

        Returns:
            Whether the plateau ends now.
        """
        if not self.until_converged or p.converged_at:
            return False
        p.grown = p.grown or _growth_has_ceased(p)
        converged = convergence_step(p.curve)
        has_converged = converged is not None and p.step >= max(converged, WARM_UP)
        if not self._out_of_time(p) and not has_converged:
            return False
        p.converged_at, p.ends_at, p.limited = p.step, math.ceil(p.step / DECAY_FROM), not has_converged
        return True

    def _limit(self, p: TrainingProgress) -> float | None:
        """Return the seconds at which the learning rates end to fall at the latest; None if only steps tell.

        That is without a time limit, and where the plateau took longer, as before the limit was set.
        """
        is_over = self.seconds is not None and p.converged_at and _seconds_at(p, p.converged_at) >= self.seconds
        return None if is_over else self.seconds

    def _out_of_time(self, p: TrainingProgress) -> bool:
        """Return whether the plateau must end now so that the training ends within the time limit."""
        return self._is_limited(p) and not p.converged_at and p.step > 0

    def _is_limited(self, p: TrainingProgress) -> bool:
        """Return whether the last part of the time limit has begun, in which the learning rates fall."""
        return self.seconds is not None and p.seconds >= DECAY_FROM * self.seconds


def objective_of(p: TrainingProgress, downscale: int) -> str:
    """Return a name of what the loss is measured on: images reduced by a factor, of some views, of some splats."""
    return f"1/{downscale}, {len(p.watched)} spared, {p.dropped:g} dropped{_JOINED if p.joined else ''}"


def _is_joined(entry: Mapping[str, Any]) -> bool:
    """Return whether the validation views were trained on, too, at an entry of the curve."""
    return str(entry.get("objective")).endswith(_JOINED)


def plateau_end(p: TrainingProgress) -> str:
    """Return a sentence without a period on why the plateau of a training until convergence has ended."""
    why = "The time limit is near" if p.limited else "The training has converged"
    return f"{why}; its learning rates fall from step {p.converged_at:,} on"


def end_of_decay(p: TrainingProgress) -> float:
    """Return the step at which the learning rates end to fall, of a training whose plateau has ended."""
    return p.ends_at or p.converged_at / _DECAY_FROM_BEFORE


def _seconds_at(p: TrainingProgress, step: int) -> float:
    """Return the seconds of training until the last evaluation that is not after a step."""
    return float(next((entry.get("seconds", 0.0) for entry in reversed(p.curve) if entry["step"] <= step), 0.0))


def choose_validation_views(training: Sequence[int]) -> list[int]:
    """Choose the views on which a training until convergence validates, spread evenly over its training views.

    Args:
        training: Indices of the training views, by file name.

    Returns:
        Indices of the views not to train on, always the same for the same views; empty if there are too few.
    """
    every = max(VALIDATE_EVERY, math.ceil(len(training) / MAX_VALIDATION_VIEWS))
    chosen = list(training[every // 2 :: every])
    return chosen if len(training) - len(chosen) >= MIN_TRAINED_VIEWS else []


def expected_end(p: TrainingProgress) -> float | None:
    """Estimate the total number of steps of a training until convergence; None as long as there is no estimate."""
    if p.converged_at:
        return end_of_decay(p)
    converged = convergence_step(p.curve)
    return None if converged is None else max(converged, p.step) / DECAY_FROM


def convergence_step(curve: list[dict[str, Any]], worthwhile: float = WORTHWHILE_DB) -> float | None:
    """Extrapolate the step from which on `LOOKAHEAD` further steps gain less than `worthwhile` dB.

    Assuming that further octaves of steps gain as many dB as the latest ones, it is the step n for which
    octave * log2(1 + LOOKAHEAD / n) = worthwhile.

    Returns:
        The step; 0 if an octave gains nothing, None if the curve is too short for an estimate.
    """
    octave = _gain_per_octave(curve)
    if octave is None:
        return None
    # Treat a negligible gain as none.
    return LOOKAHEAD / (2 ** (worthwhile / octave) - 1) if octave > worthwhile / 100 else 0.0


def _growth_has_ceased(p: TrainingProgress) -> bool:
    """Return whether the number of anchors has stopped growing on the plateau, before which growth may have been off.

    Curves of older trainings may not contain the number.
    """
    counted = [(entry["step"], entry["anchors"]) for entry in p.curve if "anchors" in entry]
    last, now = counted[-1] if counted else (0, 0)
    first = max(WARM_UP, p.plateau_at or 0)
    before = [anchors for step, anchors in counted if first <= step <= last / 2**GROWTH_OCTAVES]
    return bool(before) and now < MIN_GROWTH * before[-1]


def _gain_per_octave(curve: list[dict[str, Any]]) -> float | None:
    """Return the quality gain in dB per doubling of the number of steps; None if the curve is too short.

    The quality is the PSNR on the validation views or, if there are none, the loss in dB, as long as it is that of the
    same objective as now. It is never the PSNR on the held-out views: a training that ended where these are best would
    flatter the figures that are reported of them.
    """
    last = curve[-1]["step"] if curve else 0
    recent = [entry for entry in curve if entry["step"] >= max(WARM_UP, last / 2**OCTAVES)]
    # Entries of an earlier decay, when the validation views were trained on, tell nothing of the plateau.
    recent = [entry for entry in recent if _is_joined(entry) == _is_joined(curve[-1])]
    validated = all(entry.get("validation_psnr") is not None for entry in recent)
    key = "validation_psnr" if validated else "loss_db"
    if not validated:
        recent = [entry for entry in recent if entry.get("objective") == curve[-1].get("objective")]
    found = [(math.log2(entry["step"]), entry[key]) for entry in recent if entry.get(key) is not None]
    if len(found) < 5 or found[-1][0] - found[0][0] < MIN_OCTAVES:
        return None
    octaves, quality = np.array(found).T
    first, second = np.triu_indices(len(found), 1)
    # The median of the slopes between all pairs of evaluations (Theil-Sen estimator) is robust against outliers.
    return float(np.median((quality[second] - quality[first]) / (octaves[second] - octaves[first])))


PRESETS = {**{name: Budget(steps=steps) for name, steps in PRESET_STEPS.items()}, "final": Budget(until_converged=True)}
"""Budgets by name."""
