"""Fit of discs to a capture, beginning with a trained model of 3D Gaussians.

Discs have a surface, so meshes of them are more accurate than those of 3D Gaussians (Huang et al. 2024, "2D Gaussian
Splatting"), but they show the photos less well. A short training converts the one to the other, so that a model of 3D
Gaussians is displayed and its discs are meshed.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...model.discs import to_discs
from ...model.object_model import ObjectModel
from ...raster import devices
from ...raster.settings import EPS_2D_DISC
from ..budget import Budget
from ..scene import Scene
from ..settings import Settings
from ..state import read_result
from ..trainer import Trainer

if TYPE_CHECKING:
    from ...capture import Capture

FRACTION = 0.2
"""Number of steps, relative to those of the training."""

FIRST = 0.7
"""Progress at the first step, which determines the learning rates: there is no growth any more."""


def budget_of_discs(trained_steps: int) -> Budget:
    """Return the length of the fit for a model that was trained for a number of steps."""
    return Budget(steps=max(round(FRACTION * trained_steps), 1), first=FIRST)


def digest_of_model(model: ObjectModel) -> str:
    """Return a digest of a model's parameters, and of how discs are drawn."""
    digest = hashlib.sha256(str(EPS_2D_DISC).encode())
    tensors = (model.anchors.positions, model.anchors.rows, model.anchors.ids, *model.heads.state_dict().values())
    for tensor in tensors:
        digest.update(devices.host(tensor.detach()).tobytes())
    return digest.hexdigest()[:24]


def begin_discs(model: ObjectModel, capture: Capture, checkpoint: Path, memory_mb: float, gains: np.ndarray) -> Trainer:
    """Begin the fit.

    Args:
        model: the explicit model of 3D Gaussians, as loaded from the checkpoint of its training.
        capture: the capture that it was trained on.
        checkpoint: folder of that checkpoint, for the settings and the colors of the photos.
        memory_mb, gains: as in `Trainer.start`.

    Returns:
        A trainer to run with `budget_of_discs`.

    Raises:
        InputError: the checkpoint cannot be read.
    """
    tensors, state, _ = read_result(checkpoint)
    settings = replace(Settings(**state["settings"]), primitive="2d")
    scene = Scene(
        capture, model.classes, model.normalization, settings.zero_is_object, memory_mb,
        state["supervise_background"], model.device, gains,
    )  # fmt: skip
    discs = to_discs(model)
    discs.heads.requires_grad_()
    trainer = Trainer(scene, settings, discs, np.random.default_rng(settings.seed))
    trainer.view_step.restore(tensors)
    trainer.progress.dropped = state["progress"].get("dropped", 0.0)
    trainer.progress.joined = state["progress"].get("joined", False)
    return trainer
