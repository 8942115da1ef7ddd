"""The mean of what is trained over the latest steps.

While the rates are high, each step wobbles around a model that is better than any of them (Polyak and Juditsky 1992,
"Acceleration of stochastic approximation by averaging"), and the mean is there at any moment. It is what a training
shows, measures and leaves, finished or not. Rates that fall are still needed: without, flat splats come out worse.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

if TYPE_CHECKING:
    from ..model.object_model import ObjectModel

EVERY = 4
"""One of so many steps counts: looking at all rows takes time."""

SHARE, LONGEST = 0.1, 100
"""The mean goes back over this share of the steps so far, which may be far off still, and over so many at most."""

_PREFIX = "mean."


class Average:
    """The mean of the models that `follow` was given; at first that of `model` alone."""

    def __init__(self, model: ObjectModel) -> None:
        self._rows = model.anchors.rows.clone()
        self._heads = copy.deepcopy(model.heads).requires_grad_(False)
        self._background = model.background.detach().clone()

    def follow(self, model: ObjectModel, step: int) -> None:
        """Take in the model after a step, where that is one that counts."""
        if step % EVERY:
            return
        weight = EVERY / max(min(SHARE * step, LONGEST), EVERY)
        self._rows.lerp_(model.anchors.rows, weight)
        self._background.lerp_(model.background.detach(), weight)
        for mean, parameter in zip(self._heads.parameters(), model.heads.parameters(), strict=True):
            mean.lerp_(parameter.detach(), weight)

    def take(self, kept: torch.Tensor, new: torch.Tensor) -> None:
        """Follow a change of the anchors: of the rows so far those that are `kept` (a mask, or indices), then `new`
        (n, columns), which begin as they are."""
        self._rows = torch.cat([self._rows[kept], new])

    def of(self, model: ObjectModel) -> ObjectModel:
        """The mean as a model, where `model` is the one that it follows."""
        anchors = replace(model.anchors, rows=self._rows)
        return replace(model, anchors=anchors, heads=self._heads, background=self._background)

    def tensors(self) -> dict[str, torch.Tensor]:
        """For a checkpoint."""
        heads = {f"heads.{name}": value for name, value in self._heads.state_dict().items()}
        values = {"rows": self._rows, "background": self._background, **heads}
        return {_PREFIX + name: value for name, value in values.items()}

    @classmethod
    def of_checkpoint(cls, tensors: Mapping[str, np.ndarray], model: ObjectModel) -> Average:
        """What `tensors` gave, on the device of the model that it follows; of the model alone where there is none among
        them, as in the checkpoints of versions without a mean."""
        average = cls(model)
        found = {name.removeprefix(_PREFIX): value for name, value in tensors.items() if name.startswith(_PREFIX)}
        if not found:
            return average
        average._rows.copy_(torch.from_numpy(found.pop("rows").copy()))
        average._background.copy_(torch.from_numpy(found.pop("background").copy()))
        heads = {name.removeprefix("heads."): torch.from_numpy(value.copy()) for name, value in found.items()}
        average._heads.load_state_dict(heads)
        return average
