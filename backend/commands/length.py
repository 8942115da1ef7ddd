"""Length and expected result of a training."""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import torch

from ..capture import Capture
from ..shared.durations import Limit
from ..shared.errors import InputError
from ..shared.expectation import (
    DEFAULT_SECONDS,
    NANOSECONDS_A_PIXEL,
    expectation,
    expected_psnr,
    expected_steps,
    typical_psnr,
)
from ..training.budget import LOOKAHEAD, PRESETS, WARM_UP, Budget, TrainingProgress

_SECONDS_A_STEP = 0.02
"""Of a GPU."""


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
    budget: Budget,
    capture: Capture,
    device: torch.device,
    done: TrainingProgress | None = None,
    agreement: float | None = None,
) -> str | None:
    """Describe the expected result of a training in a sentence.

    Args:
        budget: The length of the training.
        capture: The capture.
        device: The device to train on.
        done: The progress so far, if a training is resumed.
        agreement: How well the photos agree, in dB; None if it is not known.

    Returns:
        The sentence, or None if there is no basis for an estimate.
    """
    typical = None if agreement is None else typical_psnr(agreement, _pixels(capture))
    return expectation(*_length(budget, capture, device, done), typical)


def expected_psnr_of(
    budget: Budget, capture: Capture, device: torch.device, done: TrainingProgress, agreement: float | None
) -> list[float] | None:
    """Return the bounds of the expected PSNR on held-out views, in dB, for objectgs.json; see `expected_of`."""
    if agreement is None:
        return None
    bounds = expected_psnr(typical_psnr(agreement, _pixels(capture)), *_length(budget, capture, device, done))
    return [round(bound, 2) for bound in bounds]


def expected_steps_of(budget: Budget, capture: Capture, device: torch.device, done: TrainingProgress) -> int | None:
    """Return the fewest steps that are expected of a training for a time; None for others, or without an estimate."""
    steps, seconds, pixels, trained = _length(budget, capture, device, done)
    if steps is not None or seconds is None or budget.until_converged:
        return None
    return expected_steps(seconds, pixels, trained)


def _length(
    budget: Budget, capture: Capture, device: torch.device, done: TrainingProgress | None
) -> tuple[int | None, float | None, float | None, tuple[int, float]]:
    """Return the length of a training as the arguments of `expectation`, the longest until convergence."""
    pixels = _pixels(capture) if device.type == "cpu" else None
    trained = (0, 0.0) if done is None else (done.step, done.seconds)
    return budget.steps, budget.seconds, pixels, trained


def training_seconds(budget: Budget, capture: Capture, device: torch.device, done: TrainingProgress) -> float:
    """Return about how long the rest of a training takes, for the progress of the whole command; may be a `Limit`."""
    if budget.seconds is not None and not budget.until_converged:
        return Limit(max(budget.seconds - done.seconds, 0.0))
    if done.step:
        pace = done.seconds / done.step
    else:
        pace = (
            1e-9 * float(np.mean(NANOSECONDS_A_PIXEL)) * _pixels(capture) if device.type == "cpu" else _SECONDS_A_STEP
        )
    steps = budget.steps or done.step + WARM_UP + LOOKAHEAD
    return max(steps - done.step, 0) * pace


def _pixels(capture: Capture) -> float:
    """Return the mean number of pixels of a view."""
    return float(np.mean([view.width * view.height for view in capture.views]))
