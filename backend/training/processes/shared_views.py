"""What a process sends to the others of its view's gradients."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from ...raster import devices
from ...shared.errors import InputError
from ..check_finite import Fault
from ..growth_strategy import ViewStatistics
from ..step import ViewGradients
from .team import Team

_F4, _I8, _FLAG = torch.float32, torch.int64, torch.bool


class Outcome(NamedTuple):
    """Outcome of a step on one view.

    Attributes:
        gradients: the gradients; None if no anchor is in view or the loss is not finite.
        fault: why the loss is not finite.
    """

    gradients: ViewGradients | None
    fault: Fault | None


def _on(fault: Fault, device: torch.device) -> Fault:
    return fault._replace(anchors=fault.anchors.to(device), unrecoverable=fault.unrecoverable.to(device))


class SharedViews:
    """Exchanges the outcomes of steps on one view in each process.

    Args:
        team: the processes.
        columns: number of columns of the anchors' rows.
        parameters: the parameters of the heads and of the background.
    """

    def __init__(self, team: Team, columns: int, parameters: Sequence[torch.Tensor]) -> None:
        self._team = team
        self._parameters = parameters
        self._device = parameters[0].device
        of_statistics = [(_I8, ()), (_I8, ()), (_F4, ()), (_FLAG, ()), (_F4, (2,)), (_FLAG, ())]
        # Types and rows of size, loss, seen, rows, colors, in_view, finite and usable, of each parameter, and of the
        # statistics.
        self._kinds: list[tuple[torch.dtype, tuple[int, ...]]] = [
            (_I8, ()), (_F4, ()), (_I8, ()), (_F4, (columns,)), (_F4, (2, 3)), (_I8, ()), (_FLAG, ()), (_FLAG, ()),
            *((_F4, ()) for _ in parameters), *of_statistics,
        ]  # fmt: skip

    def exchange(self, own: Outcome, problem: Exception | None, anchors: int) -> list[Outcome]:
        """Return the outcomes of all processes, in the order of their ranks; of one process, `own` itself.

        Args:
            own: outcome in this process.
            problem: the error that this process has had instead.
            anchors: number of anchors of this process' model.

        Raises:
            InputError: a process has had a problem, such as an image that cannot be read.
            ProcessLost: a process has ended.
        """
        if self._team.size == 1:
            if problem is not None:
                raise problem
            return [own]
        said = self._encoded(str(problem).encode(errors="replace") if problem else b"")
        fault = self._encoded(pickle.dumps(_on(own.fault, devices.CPU)) if own.fault else b"")
        number = torch.tensor([anchors], device=self._device)
        everyone = self._team.exchange([said, fault, number, *self._packed(own.gradients)])
        for text, *_ in everyone:
            if len(text):
                raise InputError(bytes(text.tolist()).decode(errors="replace")) from problem
        if len({int(number) for _, _, number, *_ in everyone}) > 1:
            raise RuntimeError("the processes have different models")
        return [
            Outcome(self._unpacked(rest), _on(pickle.loads(bytes(sent.tolist())), self._device) if len(sent) else None)
            for _, sent, _, *rest in everyone
        ]

    def _encoded(self, text: bytes) -> torch.Tensor:
        return torch.tensor([*text], dtype=torch.uint8, device=self._device)

    def _packed(self, g: ViewGradients | None) -> list[torch.Tensor]:
        """Return gradients as tensors, which are empty where something is None."""
        values: Sequence[torch.Tensor | np.ndarray | None] = [None] * len(self._kinds)
        if g is not None:
            statistics = [None] * 6 if g.statistics is None else g.statistics
            size = torch.tensor(g.size)
            values = [size, g.loss, g.seen, g.rows, g.colors, g.in_view, g.finite, g.usable, *g.heads, *statistics]
        return [
            torch.empty((0, *shape), dtype=kind, device=self._device)
            if value is None
            else torch.as_tensor(value).to(self._device, kind).reshape(-1, *shape)
            for value, (kind, shape) in zip(values, self._kinds, strict=True)
        ]

    def _unpacked(self, tensors: Sequence[torch.Tensor]) -> ViewGradients | None:
        """Return the gradients in the result of `_packed`."""
        found = [tensor if len(tensor) else None for tensor in tensors]
        size, loss, seen, rows, colors, in_view, finite, usable, *others = found
        if size is None or loss is None or seen is None or rows is None:
            return None
        count = len(self._parameters)
        heads = [
            None if gradient is None else gradient.view_as(parameter)
            for gradient, parameter in zip(others[:count], self._parameters, strict=True)
        ]
        anchors, source, opacities, drawn, screen_gradient, usable_there = tensors[-6:]
        statistics = None
        if len(anchors):
            there = usable_there if len(usable_there) else None
            statistics = ViewStatistics(anchors, source, opacities, drawn, screen_gradient, there)
        width, height = size.tolist()
        return ViewGradients(
            (width, height), loss[0], seen, rows, heads, None if colors is None else colors[0],
            None if in_view is None else in_view[0], None if finite is None else finite[0], usable, statistics,
        )  # fmt: skip
