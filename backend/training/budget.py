"""How long to train: for so many steps, for so long, or until it stops getting better."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..expectation import PRESET_STEPS
from .settings import GROW_UNTIL, PLATEAU_FROM, PLATEAU_UNTIL

_EVALUATIONS = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 1.0)
"""Shares of a training whose length is known after which it is measured."""

_EVALUATE_AFTER, _EVALUATE_EARLY, _EVALUATE_EVERY = 100, 1.3, 1.08
"""One whose end is open is measured after so many steps, and whenever there are so many times as many: at first, and
where the measurements decide."""

WARM_UP = 600
"""Steps until the plateau of a training whose end is open: large scenes differ in how long they stay there. Before, the
error falls faster than it will. Anchors that grow sooner become more and no better."""

AHEAD, WORTH = 1000, 0.36
"""The plateau is flat where so many more steps would bring less than so many dB."""

OCTAVES, FEWEST_OCTAVES = 2, 1.25
"""What they would bring is judged by the measurements since there were 2 to the power of this times fewer steps; not by
those over less than the other power, whose noise hides how the curve goes."""

GROWN_AFTER, GROWN_BY = 0.5, 1.01
"""Growth ends where anchors have become less than so many times as many since there were 2 to the power of the first
fewer steps: from then on it only moves them, which takes time and disturbs the others."""

SETTLING_FROM = 0.9
"""A training whose end is open leaves the plateau after this share of its steps, later than others: what it has come to
on the plateau is as good as with rates that fall sooner, in as many steps."""


@dataclass
class Progress:
    """Where a training stands; saved with every checkpoint.

    last_growth: step of the latest growth. skipped: updates that were not finite, and faults: how many steps met each
    cause of them that was found. queue: views still to come.
    evaluated: how many of the evaluations of a training of known length are behind, or, where the end is open, the
    step of the latest. grown: whether its anchors have become as many as they will. settled_from: the step from which
    its rates fall, 0 before.
    curve: an entry for each evaluation, with seconds, step, number of anchors, loss (dB) and what was measured.
    """

    step: int = 0
    seconds: float = 0.0
    last_growth: int = 0
    skipped: int = 0
    faults: dict[str, int] = field(default_factory=dict)
    queue: list[int] = field(default_factory=list)
    evaluated: int = 0
    grown: bool = False
    settled_from: int = 0
    curve: list[dict[str, Any]] = field(default_factory=list)

    @property
    def causes(self) -> str:
        """The faults and their steps, most frequent first, in words."""
        by_count = sorted(self.faults.items(), key=lambda entry: -entry[1])
        return ", ".join(f"{what} ({count} {'step' if count == 1 else 'steps'})" for what, count in by_count)


@dataclass(frozen=True)
class Budget:
    """How long to train in all: so many steps, or so many seconds (schedules then follow the clock).

    until_flat: train until more would bring little; `seconds` are then the most, None: as long as it takes.
    """

    steps: int | None = None
    seconds: float | None = None
    until_flat: bool = False

    def share(self, p: Progress) -> float:
        """How much of the training is behind, 0 to 1. Where the end is open, it stays on the plateau until
        `settle`, first where anchors grow and then where they do not."""
        if self.until_flat:
            if not p.settled_from and p.step < WARM_UP:
                return PLATEAU_FROM * p.step / WARM_UP
            if not p.settled_from:
                return (GROW_UNTIL + (PLATEAU_UNTIL if p.grown else PLATEAU_FROM)) / 2
            settling = (p.step - p.settled_from) / (p.settled_from / SETTLING_FROM - p.settled_from)
            return min(PLATEAU_UNTIL + (1 - PLATEAU_UNTIL) * settling, 1.0)
        if self.steps is not None:
            return min(p.step / self.steps, 1.0)
        assert self.seconds is not None
        return min(p.seconds / self.seconds, 1.0)

    def remaining(self, p: Progress, pace: float) -> float | None:
        """Seconds left, given the seconds a step takes, about so many where the end is open; None where nobody knows
        yet."""
        if self.until_flat:
            end = expected_end(p)
            left = [] if end is None else [max(end - p.step, 0) * pace]
            left += [] if self.seconds is None or p.settled_from else [max(self.seconds - p.seconds, 0.0)]
            return min(left, default=None)
        if self.steps is not None:
            return max(self.steps - p.step, 0) * pace
        assert self.seconds is not None
        return max(self.seconds - p.seconds, 0.0)

    def behind(self, p: Progress) -> float:
        """How much of the training is behind for those who wait for it, 0 to 1: where the end is open, `AHEAD` more
        steps are taken to come as long as nobody knows."""
        share = self.share(p)
        if not self.until_flat or share >= 1.0:
            return share
        end = expected_end(p)
        steps = p.step / (p.step + AHEAD if end is None else max(end, p.step + 1))
        return steps if self.seconds is None else min(max(steps, p.seconds / self.seconds), 1.0)

    def begin(self, p: Progress) -> None:
        """Take over a training that may have been begun under another budget."""
        p.evaluated = p.step if self.until_flat else bisect_right(_EVALUATIONS, self.share(p))

    def evaluation_is_due(self, p: Progress) -> bool:
        """Whether it is time to measure; says so once."""
        share = self.share(p)
        if self.until_flat:
            times = _EVALUATE_EARLY if p.step < WARM_UP else _EVALUATE_EVERY
            due = p.step >= max(_EVALUATE_AFTER, times * p.evaluated)
            due = due or self._out_of_time(p) or (share >= 1.0 and p.step > p.evaluated)
            behind = p.step if due else p.evaluated
        else:
            behind = bisect_right(_EVALUATIONS, share)
            due = behind > p.evaluated
        p.evaluated = behind
        return due

    def settle(self, p: Progress) -> bool:
        """End growth where it is over, and leave the plateau where it is flat or time runs out; whether it is left
        now."""
        if not self.until_flat or p.settled_from:
            return False
        p.grown = p.grown or _grown(p.curve)
        flat = flat_from(p.curve)
        if not self._out_of_time(p) and (flat is None or p.step < max(flat, WARM_UP)):
            return False
        p.settled_from = p.step
        return True

    def _out_of_time(self, p: Progress) -> bool:
        """Whether the plateau has to be left now for the training to end in time."""
        if self.seconds is None or p.settled_from or not p.step:
            return False
        return p.seconds >= SETTLING_FROM * self.seconds


def expected_end(p: Progress) -> float | None:
    """After how many steps a training whose end is open will be over; None as long as nobody knows."""
    if p.settled_from:
        return p.settled_from / SETTLING_FROM
    flat = flat_from(p.curve)
    return None if flat is None else max(flat, p.step) / SETTLING_FROM


def flat_from(curve: list[dict[str, Any]]) -> float | None:
    """After how many steps on the plateau `AHEAD` more bring less than `WORTH`, where an octave brings the same as it
    did of late: n such that octave * log2(1 + AHEAD / n) = WORTH, 0 where it brings nothing. None where the curve tells
    too little."""
    octave = _gain_of_an_octave(curve)
    if octave is None:
        return None
    # An octave that brings next to nothing is one that brings nothing.
    return AHEAD / (2 ** (WORTH / octave) - 1) if octave > WORTH / 100 else 0.0


def _grown(curve: list[dict[str, Any]]) -> bool:
    """Whether anchors hardly become more. Curves of older trainings may not count them."""
    counted = [(entry["step"], entry["anchors"]) for entry in curve if "anchors" in entry]
    last, now = counted[-1] if counted else (0, 0)
    before = [anchors for step, anchors in counted if WARM_UP <= step <= last / 2**GROWN_AFTER]
    return bool(before) and now < GROWN_BY * before[-1]


def _gain_of_an_octave(curve: list[dict[str, Any]]) -> float | None:
    """By how many dB the error falls in twice the steps, with whose logarithm it falls: PSNR on held-out views or,
    where there are none, the loss. None where the curve tells too little."""
    last = curve[-1]["step"] if curve else 0
    recent = [entry for entry in curve if entry["step"] >= max(WARM_UP, last / 2**OCTAVES)]
    key = "psnr" if all(entry.get("psnr") is not None for entry in recent) else "loss_db"
    found = [(math.log2(entry["step"]), entry[key]) for entry in recent if entry.get(key) is not None]
    if len(found) < 5 or found[-1][0] - found[0][0] < FEWEST_OCTAVES:
        return None
    octaves, quality = np.array(found).T
    first, second = np.triu_indices(len(found), 1)
    # The median of the slopes between any two measurements (Theil and Sen), which a bad one does not tilt.
    return float(np.median((quality[second] - quality[first]) / (octaves[second] - octaves[first])))


PRESETS = {**{name: Budget(steps=steps) for name, steps in PRESET_STEPS.items()}, "final": Budget(until_flat=True)}
"""Lengths by name."""
