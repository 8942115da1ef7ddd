"""Length and expected result of a training."""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import torch

from ..capture import Capture
from ..shared.errors import InputError
from ..shared.expectation import DEFAULT_SECONDS, expectation
from ..training.budget import PRESETS, Budget, TrainingProgress


def budget_of(options: argparse.Namespace) -> Budget:
    """Return the length of a training from the options.

    Raises:
        InputError: If the options give two lengths.
    """
    seconds = None if options.minutes is None else 60.0 * options.minutes
    if options.preset is None:
        return Budget(options.steps, None if options.steps else seconds or DEFAULT_SECONDS)
    if options.steps or (seconds and options.preset != "final"):
        other = "--steps" if options.steps else "--minutes"
        raise InputError(
            f"--preset {options.preset} sets the length of the training, and so does {other}; leave one of them out."
        )
    return replace(PRESETS[options.preset], seconds=seconds)


def expected_of(
    budget: Budget, capture: Capture, device: torch.device, done: TrainingProgress | None = None
) -> str | None:
    """Describe the expected result of a training in a sentence.

    Args:
        budget: The length of the training.
        capture: The capture.
        device: The device to train on.
        done: The progress so far, if a training is resumed.

    Returns:
        The sentence, or None if the training runs until convergence or there is no basis for an estimate.
    """
    if budget.until_converged:
        return None
    pixels = float(np.mean([view.width * view.height for view in capture.views])) if device.type == "cpu" else None
    trained = (0, 0.0) if done is None else (done.step, done.seconds)
    return expectation(budget.steps, budget.seconds, pixels, trained)
