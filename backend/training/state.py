"""Conversion of a training's state to and from the tensors and JSON of a checkpoint."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..model.anchors import Anchors
from ..model.checkpoint import load_checkpoint
from ..model.growth import GrowthStatistics
from ..model.heads import Heads
from ..model.object_model import Normalization, ObjectModel
from ..raster import devices
from ..shared.class_table import ClassTable
from ..shared.errors import InputError
from .average import Average
from .budget import TrainingProgress
from .settings import Settings

_GROWTH = ("gradient", "visits", "opacity", "views")
_HEAD_ADAM = ("step", "exp_avg", "exp_avg_sq")

_FORMER_TENSORS = {"adam.first": "adam.exp_avg", "adam.second": "adam.exp_avg_sq"}
_FORMER_KEYS = {"teach_unlabelled": "supervise_background", "centre": "center", "settled_from": "converged_at"}
"""Names in checkpoints written by older versions, and their current names."""


def read_checkpoint(folder: Path) -> tuple[dict[str, np.ndarray], dict[str, Any], str | None] | None:
    """Read the latest complete checkpoint in `folder`.

    Returns:
        The tensors, the state, and a warning or None; None if there is no checkpoint.

    Raises:
        InputError: there are checkpoint files, but none can be read.
    """
    found = load_checkpoint(folder)
    if found is None:
        return None
    tensors, state, warning = found
    tensors = {_FORMER_TENSORS.get(name, name): tensor for name, tensor in tensors.items()}
    state = {_FORMER_KEYS.get(key, key): value for key, value in state.items()}
    for part in ("normalization", "progress"):
        state[part] = {_FORMER_KEYS.get(key, key): value for key, value in state[part].items()}
    return tensors, state, warning


def training_tensors(
    model: ObjectModel,
    exp_avg: torch.Tensor,
    exp_avg_sq: torch.Tensor,
    statistics: GrowthStatistics,
    average: Average,
    head_optimizer: torch.optim.Optimizer,
) -> dict[str, np.ndarray]:
    """Return all tensors that the next step depends on, by their names in a checkpoint.

    exp_avg, exp_avg_sq: (N, columns), Adam's moments of the anchors' rows.
    """
    anchors = model.anchors
    tensors: dict[str, torch.Tensor | np.ndarray] = {
        "anchors.positions": anchors.positions,
        "anchors.rows": anchors.rows,
        "anchors.ids": anchors.ids,
        "adam.exp_avg": exp_avg,
        "adam.exp_avg_sq": exp_avg_sq,
        **{f"growth.{name}": getattr(statistics, name) for name in _GROWTH},
        "object_ids": model.classes.ids,
        "background": model.background,
        **average.tensors(),
        **{f"heads.{name}": value for name, value in model.heads.state_dict().items()},
    }
    for i, state in head_optimizer.state_dict()["state"].items():
        tensors |= {f"head_adam.{i}.{name}": state[name] for name in _HEAD_ADAM}
    return {name: devices.host(value) for name, value in tensors.items()}


def restore_statistics(tensors: dict[str, np.ndarray], device: torch.device) -> GrowthStatistics:
    """Return the growth statistics in a checkpoint's tensors."""
    return GrowthStatistics(*(restore_tensor(tensors, f"growth.{name}", device) for name in _GROWTH))


def restore_head_optimizer(
    optimizer: torch.optim.Optimizer, tensors: dict[str, np.ndarray], device: torch.device
) -> None:
    """Load the state of the heads' optimizer from a checkpoint."""
    saved = optimizer.state_dict()
    count = sum(len(group["params"]) for group in saved["param_groups"])
    saved["state"] = {
        i: {name: restore_tensor(tensors, f"head_adam.{i}.{name}", device) for name in _HEAD_ADAM}
        for i in range(count)
        if f"head_adam.{i}.step" in tensors
    }
    optimizer.load_state_dict(saved)


def restore_tensor(tensors: dict[str, np.ndarray], name: str, device: torch.device) -> torch.Tensor:
    """Return a copy of a checkpoint's tensor on `device`."""
    return torch.from_numpy(tensors[name].copy()).to(device)


def model_from_checkpoint(tensors: dict[str, np.ndarray], state: dict[str, Any]) -> ObjectModel:
    """Return the model stored in a checkpoint's tensors and state."""
    settings = Settings(**state["settings"])
    anchors = Anchors(
        settings.layout, float(state["voxel"]),
        *(torch.from_numpy(tensors[f"anchors.{n}"].copy()) for n in ("positions", "rows", "ids")),
    )  # fmt: skip
    heads = Heads(settings.layout, settings.mode, settings.sh_degree, torch.Generator())
    heads.load_state_dict(
        {k.removeprefix("heads."): torch.from_numpy(v.copy()) for k, v in tensors.items() if k.startswith("heads.")}
    )
    center, scale = state["normalization"]["center"], state["normalization"]["scale"]
    normalization = Normalization((center[0], center[1], center[2]), scale)
    return ObjectModel(
        anchors, heads, torch.from_numpy(tensors["background"].copy()), ClassTable(tensors["object_ids"]),
        normalization, settings.primitive,
    )  # fmt: skip


def load_model(folder: Path, device: torch.device = devices.CPU) -> tuple[ObjectModel, dict[str, Any], str | None]:
    """Load the result of a training, the mean of the model over the latest steps.

    Args:
        folder: The folder of the checkpoint.
        device: Where the model is to be.

    Returns:
        The model on `device`, the checkpoint's state, and a warning or None.

    Raises:
        InputError: There is no checkpoint in `folder`, or none can be read.
    """
    found = read_checkpoint(folder)
    if found is None:
        raise InputError(f"{folder} holds no checkpoint; train first.")
    tensors, state, warning = found
    model = model_from_checkpoint(tensors, state)
    return Average.from_checkpoint(tensors, model).of(model).to(device), state, warning


def progress_of(state: dict[str, Any]) -> TrainingProgress:
    """Return the training's progress stored in a checkpoint's state."""
    return TrainingProgress(**json.loads(json.dumps(state["progress"])))
