"""Adam for the heads and the background, all of whose parameters change in each step.

The computation is torch's; its class `torch.optim.Adam` would first import torch's compiler, which takes seconds.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from torch.optim.adam import adam

from ...gpu.kernel import kernel
from ...raster import devices
from .adam import BETA1, BETA2, EPSILON, LARGEST_GRADIENT, direction

MOMENTS, STEP = ("exp_avg", "exp_avg_sq"), "step"
"""Names of the state of a parameter: tensors of its shape, and the number of steps."""


_TABLE_COLUMNS = 7
"""Of the GPU kernels' table of tensors (tensors.h)."""
_CHECKED_BY, _BLOCKS, _THREADS = 1024, 8, 256
"""Number of threads that check all gradients on a GPU; blocks that update a tensor, and their threads."""


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

    @property
    def parameters(self) -> Sequence[torch.Tensor]:
        """The parameters of all groups."""
        return self._parameters

    @property
    def gradients(self) -> list[torch.Tensor | None]:
        """The gradients of the parameters, None for those that have none."""
        return [parameter.grad for parameter in self._parameters]

    @gradients.setter
    def gradients(self, gradients: Sequence[torch.Tensor | None]) -> None:
        for parameter, gradient in zip(self._parameters, gradients, strict=True):
            parameter.grad = gradient

    @contextmanager
    def ahead(self, count: int, rates: Mapping[str, float]) -> Iterator[None]:
        """Let the parameters be, within the context, where they are expected after further steps, by their moments.

        Args:
            count: number of steps.
            rates: The learning rate of each group.
        """
        before = [parameter.detach().clone() for parameter in self._parameters]
        try:
            with torch.no_grad():
                for name, numbers in self._numbers.items():
                    for i in numbers:
                        if i in self._states:
                            self._parameters[i].sub_(self._direction(self._states[i]), alpha=count * rates[name])
            yield
        finally:
            with torch.no_grad():
                for parameter, value in zip(self._parameters, before, strict=True):
                    parameter.copy_(value)

    @torch.no_grad()
    def step(self, rates: Mapping[str, float], finite: torch.Tensor | None = None) -> torch.Tensor:
        """Update the parameters that have gradients, in place, if all gradients are smaller than LARGEST_GRADIENT.

        Args:
            rates: The learning rate of each group.
            finite: () bool; where it is False, nothing changes. It is read on the device, without synchronization.

        Returns:
            () bool, on the device: whether the parameters were updated.
        """
        stepped = {
            name: [i for i in numbers if self._parameters[i].grad is not None]
            for name, numbers in self._numbers.items()
        }
        if devices.on_gpu(self._parameters[0]):
            return self._step_on_gpu([(i, rates[name]) for name, numbers in stepped.items() for i in numbers], finite)
        every = [gradient.flatten() for parameter in self._parameters if (gradient := parameter.grad) is not None]
        usable = (torch.cat(every).abs() < LARGEST_GRADIENT).all()
        if finite is not None:
            usable = usable & finite
        for name, numbers in stepped.items():
            states = [self._state(i) for i in numbers]
            if numbers:
                adam(
                    [self._parameters[i] for i in numbers],
                    [gradient for i in numbers if (gradient := self._parameters[i].grad) is not None],
                    [state["exp_avg"] for state in states],
                    [state["exp_avg_sq"] for state in states],
                    [],
                    [state["step"] for state in states],
                    fused=True,
                    found_inf=(~usable).float(),
                    amsgrad=False,
                    beta1=BETA1,
                    beta2=BETA2,
                    lr=rates[name],
                    weight_decay=0.0,
                    eps=EPSILON,
                    maximize=False,
                )
        return usable

    def _step_on_gpu(self, stepped: Sequence[tuple[int, float]], finite: torch.Tensor | None) -> torch.Tensor:
        """Implement `step` for the parameters with these numbers and learning rates."""
        device = self._parameters[0].device
        table = np.zeros((len(stepped), _TABLE_COLUMNS), np.int64)
        gradients = []
        for row, (i, rate) in zip(table, stepped, strict=True):
            parameter, state = self._parameters[i], self._state(i)
            assert parameter.grad is not None
            gradients.append(parameter.grad.contiguous())
            tensors = (parameter, gradients[-1], state["exp_avg"], state["exp_avg_sq"], state[STEP])
            row[:-1] = *(tensor.data_ptr() for tensor in tensors), parameter.numel()
            row[-1:].view(np.float32)[0] = rate
        rows = devices.upload(table, device)
        usable = torch.empty((), dtype=torch.bool, device=device)
        kernel("check_tensors", LARGEST_GRADIENT=LARGEST_GRADIENT)(1, _CHECKED_BY, rows, len(stepped), finite, usable)
        kernel("step_tensors", BLOCKS_PER_TENSOR=_BLOCKS, BETA1=BETA1, BETA2=BETA2, EPSILON=EPSILON)(
            len(stepped) * _BLOCKS, _THREADS, rows, usable
        )
        return usable

    @staticmethod
    def _direction(state: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return the change of a parameter in a step of Adam, for a learning rate of -1."""
        # Of a parameter that was never updated, everything is 0.
        correction1, correction2 = ((1 - beta ** state[STEP]).clamp(min=EPSILON) for beta in (BETA1, BETA2))
        return direction(state["exp_avg"], state["exp_avg_sq"], correction1, correction2)

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
