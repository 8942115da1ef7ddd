"""Training of object IDs into a model that was trained without masks, or with other ones.

The splats keep their places and colors, and get the IDs that were found for them. An anchor has one ID for all of its
splats, so an anchor whose splats belong to several objects becomes several. The training then goes on for a while with
masks of the objects, which separates splats that reach across the border of two objects.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ...shared.class_table import ClassTable
from ..budget import Budget
from ..settings import Settings
from ..state import require_checkpoint
from ..trainer import Trainer

if TYPE_CHECKING:
    from ...capture import Capture

FRACTION, MOST = 0.2, 1000
"""Number of steps, relative to those of the training, and at most."""

FIRST = 0.4
"""Progress at the first step, which determines the learning rates and growth: borders need splats of their own."""

_ABSENT = -20.0
"""Residual of the opacity with which an offset has no splat, whatever the heads add."""

_OF_ANCHORS = ("anchors.positions", "anchors.rows", "adam.exp_avg", "adam.exp_avg_sq", "mean.rows")
_OF_STATISTICS = ("growth.gradient", "growth.visits", "growth.opacity", "growth.views")


def budget_of_labels(trained_steps: int) -> Budget:
    """Return the length of the training with labels, for a model that was trained for a number of steps before."""
    steps = min(max(round(FRACTION * trained_steps), 1), MOST)
    return Budget(steps=trained_steps + steps, first=FIRST, first_step=trained_steps)


def begin_with_labels(
    source: np.ndarray,
    object_ids: np.ndarray,
    capture: Capture,
    checkpoint: Path,
    memory_mb: float,
    device: torch.device,
    gains: np.ndarray,
    supervise_background: bool,
    semantic_weight: float,
) -> Trainer:
    """Continue a training with other object IDs.

    Args:
        source: (N,) int64, anchor * offsets + offset of each splat of the model that `load_model` loads.
        object_ids: (N,) int64, the new ID of each of these splats, 0 for none.
        capture: the capture that it was trained on, with masks of the objects.
        checkpoint: folder of its checkpoint, which is not changed.
        memory_mb, device, gains, supervise_background: as in `Trainer.start`.
        semantic_weight: weight of the loss of the IDs from now on.

    Returns:
        A trainer to run with `budget_of_labels`.

    Raises:
        InputError: the checkpoint cannot be read.
    """
    tensors, state, _ = require_checkpoint(checkpoint)
    settings = {**state["settings"], "semantic_weight": semantic_weight}
    state = {**state, "settings": settings, "supervise_background": supervise_background}
    plateau = {
        "watched": [], "grown": False, "converged_at": 0, "ends_at": 0, "limited": False, "smooth_loss": None
    }  # fmt: skip
    state["progress"] = {**state["progress"], **plateau}
    return Trainer.restore(capture, relabeled(tensors, state, source, object_ids), state, memory_mb, device, gains)


def relabeled(
    tensors: dict[str, np.ndarray], state: dict[str, Any], source: np.ndarray, object_ids: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the tensors of a checkpoint with other object IDs, without the anchors that have no splats.

    tensors, state: of the checkpoint. source, object_ids: as in `begin_with_labels`.
    """
    layout = Settings(**state["settings"]).layout
    classes, k = ClassTable(np.concatenate([[0], object_ids])), layout.offsets
    pairs, pair_of = np.unique(source // k * len(classes) + classes.classes_of(object_ids), return_inverse=True)
    parents, has = pairs // len(classes), np.zeros((len(pairs), k), np.bool_)
    has[pair_of, source % k] = True
    changed = {**tensors, "object_ids": classes.ids, "anchors.ids": (pairs % len(classes)).astype(np.int32)}
    for name in _OF_ANCHORS:
        if name in tensors:
            changed[name] = tensors[name][parents]
    for name in ("anchors.rows", "mean.rows"):
        if name in tensors:
            opacity = changed[name][:, layout.opacity_columns]
            changed[name][:, layout.opacity_columns] = np.where(has, opacity, np.float32(_ABSENT))
    for name in _OF_STATISTICS:
        width = len(tensors[name]) // max(len(tensors["anchors.ids"]), 1)
        changed[name] = np.zeros(width * len(pairs), tensors[name].dtype)
    return changed
