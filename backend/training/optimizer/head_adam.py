"""Adam for the heads and the background, all of whose parameters change in each step.

The computation is torch's; its class `torch.optim.Adam` would first import torch's compiler, which takes seconds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch.optim.adam import adam

from .adam import BETA1, BETA2, EPSILON

MOMENTS, STEP = ("exp_avg", "exp_avg_sq"), "step"
"""Names of the state of a parameter: tensors of its shape, and the number of steps."""


class HeadAdam:
    """Adam (Kingma and Ba 2015, algorithm 1) with a learning rate for each group of parameters.

    Args:
        groups: The parameters by the name of their group.

    Attributes:
        groups: As given.
    """

    def __init__(self, groups: Mapping[str, Sequence[torch.Tensor]]) -> None:
        self.groups = groups
        self._parameters = [parameter for group in groups.values() for parameter in group]
        numbers = iter(range(len(self._parameters)))
        self._numbers = {name: [next(numbers) for _ in group] for name, group in groups.items()}
        self._states: dict[int, dict[str, torch.Tensor]] = {}

    def zero_grad(self) -> None:
        """Remove the gradients."""
        for parameter in self._parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self, rates: Mapping[str, float], skipped: torch.Tensor) -> None:
        """Update the parameters that have gradients, in place.

        Args:
            rates: The learning rate of each group.
            skipped: () float32; where it is not 0, nothing changes. It is read on the device, without synchronization.
        """
        for name, numbers in self._numbers.items():
            stepped = [i for i in numbers if self._parameters[i].grad is not None]
            states = [self._state(i) for i in stepped]
            if stepped:
                adam(
                    [self._parameters[i] for i in stepped],
                    [gradient for i in stepped if (gradient := self._parameters[i].grad) is not None],
                    [state["exp_avg"] for state in states],
                    [state["exp_avg_sq"] for state in states],
                    [],
                    [state["step"] for state in states],
                    fused=True,
                    found_inf=skipped,
                    amsgrad=False,
                    beta1=BETA1,
                    beta2=BETA2,
                    lr=rates[name],
                    weight_decay=0.0,
                    eps=EPSILON,
                    maximize=False,
                )

    def _state(self, number: int) -> dict[str, torch.Tensor]:
        if number not in self._states:
            parameter = self._parameters[number]
            self._states[number] = {
                STEP: torch.zeros((), device=parameter.device),
                **{moment: torch.zeros_like(parameter) for moment in MOMENTS},
            }
        return self._states[number]

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the state of the parameters that were updated, by name in a checkpoint."""
        return {checkpoint_name(i, name): value for i, state in self._states.items() for name, value in state.items()}

    def restore(self, tensors: Mapping[str, np.ndarray]) -> None:
        """Load the state from a checkpoint's tensors."""
        self._states = {
            number: {
                name: torch.from_numpy(tensors[checkpoint_name(number, name)].copy()).to(parameter.device)
                for name in (STEP, *MOMENTS)
            }
            for number, parameter in enumerate(self._parameters)
            if checkpoint_name(number, STEP) in tensors
        }


def checkpoint_name(number: int, name: str) -> str:
    """Return the name in checkpoints of a part of the state of a parameter, whose number counts through all groups."""
    return f"head_adam.{number}.{name}"
