"""How long a training is asked to be, and what is to be expected of it."""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import torch

from ..capture import Capture
from ..expectation import DEFAULT_SECONDS, expectation
from ..protocol import InputError
from ..training.budget import PRESETS, Budget, Progress


def budget_of(options: argparse.Namespace) -> Budget:
    """How long to train, as asked for; InputError where it is asked for twice."""
    seconds = None if options.minutes is None else 60.0 * options.minutes
    if options.preset is None:
        return Budget(options.steps, None if options.steps else seconds or DEFAULT_SECONDS)
    if options.steps or (seconds and options.preset != "final"):
        other = "--steps" if options.steps else "--minutes"
        raise InputError(f"--preset {options.preset} says how long to train, and so does {other}; leave one out.")
    return replace(PRESETS[options.preset], seconds=seconds)


def expected_of(budget: Budget, capture: Capture, place: torch.device, done: Progress | None = None) -> str | None:
    """What to expect of a training of this length, in a sentence; None where it has an open end or nobody knows."""
    if budget.until_flat:
        return None
    pixels = float(np.mean([view.width * view.height for view in capture.views])) if place.type == "cpu" else None
    trained = (0, 0.0) if done is None else (done.step, done.seconds)
    return expectation(budget.steps, budget.seconds, pixels, trained)
