"""Running mean of the model over the latest steps.

While learning rates are high, the model oscillates around a mean that is better than any single step (Polyak and
Juditsky 1992, "Acceleration of stochastic approximation by averaging"). The mean is displayed, evaluated and exported,
for finished and for stopped trainings. Learning rate decay is still required: without it, 2D splats become worse.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from ...model.anchors import kept_and_added

if TYPE_CHECKING:
    from ...model.object_model import ObjectModel

EVERY = 4
"""Number of steps between updates of the mean, since an update of all rows takes time."""

FRACTION, MAX_STEPS = 0.1, 100
"""The mean covers this fraction of the steps so far, since early models may be far off, but at most this number."""

PREFIX = "mean."
"""With which the names of the mean's tensors begin in a checkpoint."""


class Average:
    """Running mean of the models passed to `follow`; initially a copy of `model`.

    Args:
        model: the model.
        fixed: number of anchors, the first ones, that do not change and of which no mean is kept.
        rows: (n, columns), the mean of the other anchors' rows, if it is known.

    Attributes:
        rows: (n, columns), that mean.
    """

    def __init__(self, model: ObjectModel, fixed: int = 0, rows: torch.Tensor | None = None) -> None:
        self._fixed = fixed
        self.rows = model.anchors.rows[fixed:].clone() if rows is None else rows
        self._heads = copy.deepcopy(model.heads).requires_grad_(False)
        self._background = model.background.detach().clone()

    def follow(self, model: ObjectModel, step: int) -> None:
        """Update the mean with the model after `step`; does nothing in most steps (see EVERY)."""
        if step % EVERY:
            return
        weight = EVERY / max(min(FRACTION * step, MAX_STEPS), EVERY)
        self.rows.lerp_(model.anchors.rows[self._fixed :], weight)
        self._background.lerp_(model.background.detach(), weight)
        for mean, parameter in zip(self._heads.parameters(), model.heads.parameters(), strict=True):
            mean.lerp_(parameter.detach(), weight)

    def take(self, kept: torch.Tensor, new: torch.Tensor) -> None:
        """Apply a change of the anchors.

        Args:
            kept: (n,) int64, indices of the rows that are kept, not counting those of fixed anchors.
            new: (m, columns), rows that are appended.
        """
        self.rows = kept_and_added(self.rows, kept, new)

    def of(self, model: ObjectModel) -> ObjectModel:
        """Return the mean as a model; `model` is the model in training."""
        fixed = model.anchors.rows[: self._fixed]
        anchors = replace(model.anchors, rows=torch.cat([fixed, self.rows]) if self._fixed else self.rows)
        return replace(model, anchors=anchors, heads=self._heads, background=self._background)

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the mean as tensors for a checkpoint."""
        heads = {f"heads.{name}": value for name, value in self._heads.state_dict().items()}
        values = {"rows": self.rows, "background": self._background, **heads}
        return {PREFIX + name: value for name, value in values.items()}

    @classmethod
    def from_checkpoint(cls, tensors: Mapping[str, np.ndarray], model: ObjectModel, fixed: int = 0) -> Average:
        """Restore the mean from a checkpoint's tensors, on the device of `model`; `fixed` as for the class.

        For checkpoints without a mean, it is initialized with `model`.
        """
        found = {name.removeprefix(PREFIX): value for name, value in tensors.items() if name.startswith(PREFIX)}
        if not found:
            return cls(model, fixed)
        average = cls(model, fixed, torch.from_numpy(found.pop("rows")).to(model.device))
        average._background.copy_(torch.from_numpy(found.pop("background").copy()))
        heads = {name.removeprefix("heads."): torch.from_numpy(value.copy()) for name, value in found.items()}
        average._heads.load_state_dict(heads)
        return average
