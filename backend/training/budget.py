"""How long to train: for a number of steps, for a time, or until the training has converged."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..shared.expectation import PRESET_STEPS
from .settings import GROW_UNTIL, PLATEAU_FROM, PLATEAU_UNTIL

_EVALUATIONS = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 1.0)
"""Progress at which a training of known length is evaluated."""

_EVALUATE_AFTER, _EVALUATE_EARLY, _EVALUATE_EVERY = 100, 1.3, 1.08
"""A training until converged is evaluated first after this number of steps, then whenever the number of steps has grown
by a factor: the first one during the warm-up, the second one later, where the evaluations decide."""

WARM_UP = 600
"""Steps until the plateau of a training until converged; large scenes differ in how long they stay there. During the
warm-up, the error falls faster than it will later. Anchors that grow sooner become more and no better."""

LOOKAHEAD, WORTHWHILE_DB = 1000, 0.36
"""A training has converged when this number of further steps would gain less than this number of dB."""

OCTAVES, MIN_OCTAVES = 2, 1.25
"""The gain of further steps is extrapolated from the evaluations of the latest octaves of steps (an octave: twice the
steps). Evaluations that span fewer octaves than the second number are not used, as their noise hides the trend."""

GROWTH_OCTAVES, MIN_GROWTH = 0.5, 1.01
"""Growth ends when the number of anchors has grown by less than this factor over the latest half octave of steps: from
then on growth only moves anchors, which takes time and disturbs the others."""

DECAY_FROM = 0.9
"""A training until converged leaves the plateau of its learning rates at this fraction of its steps, later than others:
the model is as good on the plateau as after an earlier decay of equally many steps."""


@dataclass
class TrainingProgress:
    """Where a training stands; saved with every checkpoint.

    Attributes:
        last_growth: step of the latest growth.
        skipped: number of updates that were not finite.
        faults: number of steps for each known cause of such updates.
        queue: views that are still to come in this pass over the training views.
        evaluated: for a training of known length the number of evaluations so far; for one until converged the step of
            the latest.
        grown: whether growth has ended.
        converged_at: step at which the training converged, and from which its learning rates fall; 0 before.
        curve: for each evaluation the seconds, step, number of anchors, loss (dB) and measured quality.
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

    @property
    def causes(self) -> str:
        """The faults and their steps, most frequent first, in words."""
        by_count = sorted(self.faults.items(), key=lambda entry: -entry[1])
        return ", ".join(f"{what} ({count} {'step' if count == 1 else 'steps'})" for what, count in by_count)


@dataclass(frozen=True)
class Budget:
    """How long to train in all: a number of steps, or of seconds, by which the schedules then go.

    until_converged: train until further steps would gain little; `seconds` is then the limit, None: no limit.
    """

    steps: int | None = None
    seconds: float | None = None
    until_converged: bool = False

    def progress(self, p: TrainingProgress) -> float:
        """The progress that learning rates, growth and resolution follow.

        Returns:
            0 .. 1. A training until converged stays on the plateau until `check_convergence` ends it: first where
            anchors grow, then where they do not.
        """
        if self.until_converged:
            if not p.converged_at and p.step < WARM_UP:
                return PLATEAU_FROM * p.step / WARM_UP
            if not p.converged_at:
                return (GROW_UNTIL + (PLATEAU_UNTIL if p.grown else PLATEAU_FROM)) / 2
            decay = (p.step - p.converged_at) / (p.converged_at / DECAY_FROM - p.converged_at)
            return min(PLATEAU_UNTIL + (1 - PLATEAU_UNTIL) * decay, 1.0)
        if self.steps is not None:
            return min(p.step / self.steps, 1.0)
        assert self.seconds is not None
        return min(p.seconds / self.seconds, 1.0)

    def remaining(self, p: TrainingProgress, pace: float) -> float | None:
        """Estimate the seconds left.

        Args:
            p: the training.
            pace: seconds per step.

        Returns:
            None as long as the end of a training until converged cannot be estimated.
        """
        if self.until_converged:
            end = expected_end(p)
            left = [] if end is None else [max(end - p.step, 0) * pace]
            left += [] if self.seconds is None or p.converged_at else [max(self.seconds - p.seconds, 0.0)]
            return min(left, default=None)
        if self.steps is not None:
            return max(self.steps - p.step, 0) * pace
        assert self.seconds is not None
        return max(self.seconds - p.seconds, 0.0)

    def displayed_progress(self, p: TrainingProgress) -> float:
        """The progress to display, 0 .. 1: for a training until converged the fraction of the expected steps, where
        `LOOKAHEAD` further steps are expected as long as there is no estimate."""
        progress = self.progress(p)
        if not self.until_converged or progress >= 1.0:
            return progress
        end = expected_end(p)
        steps = p.step / (p.step + LOOKAHEAD if end is None else max(end, p.step + 1))
        return steps if self.seconds is None else min(max(steps, p.seconds / self.seconds), 1.0)

    def begin(self, p: TrainingProgress) -> None:
        """Take over a training that may have been begun under another budget."""
        p.evaluated = p.step if self.until_converged else bisect_right(_EVALUATIONS, self.progress(p))

    def evaluation_is_due(self, p: TrainingProgress) -> bool:
        """Whether it is time to evaluate; true once for each evaluation."""
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
        """End growth once it has ceased, and the plateau once the training has converged or time runs out.

        Returns:
            Whether the plateau ends now.
        """
        if not self.until_converged or p.converged_at:
            return False
        p.grown = p.grown or _growth_has_ceased(p.curve)
        converged = convergence_step(p.curve)
        if not self._out_of_time(p) and (converged is None or p.step < max(converged, WARM_UP)):
            return False
        p.converged_at = p.step
        return True

    def _out_of_time(self, p: TrainingProgress) -> bool:
        """Whether the plateau has to end now for the training to end in time."""
        if self.seconds is None or p.converged_at or not p.step:
            return False
        return p.seconds >= DECAY_FROM * self.seconds


def expected_end(p: TrainingProgress) -> float | None:
    """The number of steps after which a training until converged will end; None as long as there is no estimate."""
    if p.converged_at:
        return p.converged_at / DECAY_FROM
    converged = convergence_step(p.curve)
    return None if converged is None else max(converged, p.step) / DECAY_FROM


def convergence_step(curve: list[dict[str, Any]]) -> float | None:
    """Extrapolate the step from which on `LOOKAHEAD` further steps gain less than `WORTHWHILE_DB`.

    An octave of steps is assumed to gain as many dB as it did of late, so that the step is the n with
    octave * log2(1 + LOOKAHEAD / n) = WORTHWHILE_DB.

    Returns:
        0 where an octave gains nothing; None where the curve is too short to tell.
    """
    octave = _gain_per_octave(curve)
    if octave is None:
        return None
    # An octave that gains next to nothing is one that gains nothing.
    return LOOKAHEAD / (2 ** (WORTHWHILE_DB / octave) - 1) if octave > WORTHWHILE_DB / 100 else 0.0


def _growth_has_ceased(curve: list[dict[str, Any]]) -> bool:
    """Whether the number of anchors hardly grows. Curves of older trainings may not contain it."""
    counted = [(entry["step"], entry["anchors"]) for entry in curve if "anchors" in entry]
    last, now = counted[-1] if counted else (0, 0)
    before = [anchors for step, anchors in counted if WARM_UP <= step <= last / 2**GROWTH_OCTAVES]
    return bool(before) and now < MIN_GROWTH * before[-1]


def _gain_per_octave(curve: list[dict[str, Any]]) -> float | None:
    """The dB by which quality rises in twice the steps, as it rises with their logarithm: PSNR on held-out views or,
    where there are none, the loss. None where the curve is too short to tell."""
    last = curve[-1]["step"] if curve else 0
    recent = [entry for entry in curve if entry["step"] >= max(WARM_UP, last / 2**OCTAVES)]
    key = "psnr" if all(entry.get("psnr") is not None for entry in recent) else "loss_db"
    found = [(math.log2(entry["step"]), entry[key]) for entry in recent if entry.get(key) is not None]
    if len(found) < 5 or found[-1][0] - found[0][0] < MIN_OCTAVES:
        return None
    octaves, quality = np.array(found).T
    first, second = np.triu_indices(len(found), 1)
    # The median of the slopes between any two evaluations (Theil and Sen), robust against single bad ones.
    return float(np.median((quality[second] - quality[first]) / (octaves[second] - octaves[first])))


PRESETS = {**{name: Budget(steps=steps) for name, steps in PRESET_STEPS.items()}, "final": Budget(until_converged=True)}
"""Lengths by name."""
