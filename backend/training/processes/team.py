"""The processes that train together, as torchrun starts them, and what they send to each other.

All have the same model. In each step every process computes the gradients of another view, all processes receive the
gradients of all, and apply them one after the other in the same order, so that their models stay the same, bit for bit.
The first process leads: it decides what is done next, and the others follow.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from enum import IntEnum
from typing import Any

import torch

from ...raster import devices
from ...shared.errors import Cancelled, InputError, ProcessLost

_ALIGNMENT = 8
"""Bytes: each tensor of a message begins at a multiple of this."""

_LONGEST_WAIT = timedelta(days=7)
"""A process that ends is noticed at once. Others may wait long for the first one, which also plans and evaluates."""

_LOST = "Another process of the training has ended; run the same command again to resume from the last checkpoint."


class Order(IntEnum):
    """What the first process tells the others to do next."""

    END = 0
    """End."""
    OPEN = 1
    """Open the reconstruction and its checkpoint."""
    STATE = 2
    """Receive the progress of the training."""
    STEP = 3
    """Train on one view each."""


class Team:
    """One process alone.

    Attributes:
        rank: number of this process, from 0 on.
        size: number of processes.
    """

    rank = 0
    size = 1

    def tell(self, order: Order, progress: float = 0.0, closely: bool = False) -> None:
        """Tell the other processes what to do; only in the first one.

        Args:
            order: what to do.
            progress: progress of the training, 0 .. 1, for a step.
            closely: whether the step is checked for values that are not finite (`FiniteCheck.at_once`).

        Raises:
            ProcessLost: another process has ended.
        """

    def tell_state(self, state: dict[str, Any]) -> None:
        """Send the state of the training to the other processes, which `receive` it; only in the first one.

        Raises:
            ProcessLost: another process has ended.
        """

    def exchange(self, tensors: Sequence[torch.Tensor]) -> list[Sequence[torch.Tensor]]:
        """Send tensors to all processes, and return those of each, in the order of their ranks.

        Args:
            tensors: as many in each process, in the same order, of the same type and shape but for the first dimension.

        Raises:
            ProcessLost: another process has ended.
        """
        return [tensors]

    @contextmanager
    def leading(self) -> Iterator[None]:
        """At the end, and for errors between steps, tell the other processes to end; only in the first one.

        For other errors, the others may wait for something else, and end when this process does.
        """
        try:
            yield
        except (InputError, OSError, Cancelled):
            self.close()
            raise
        self.close()

    def close(self) -> None:
        """Disconnect; the first process also tells the others to end."""


class Processes(Team):
    """Several processes, which torchrun has started."""

    def __init__(self, device: torch.device) -> None:
        import torch.distributed as distributed

        self._distributed = distributed
        self._device = device
        # Without NCCL, gradients go through the memory of the CPU.
        has_nccl = torch.cuda.is_available() and distributed.is_nccl_available()
        with _connected():
            distributed.init_process_group("cpu:gloo,cuda:nccl" if has_nccl else "gloo", timeout=_LONGEST_WAIT)
        self._by_nccl = device.type == "cuda" and has_nccl
        self.rank, self.size = distributed.get_rank(), distributed.get_world_size()
        on_gpu = [torch.zeros(1, dtype=torch.int64) for _ in range(self.size)]
        with _connected():
            distributed.all_gather(on_gpu, torch.tensor([int(device.type != "cpu")]))
        if len({int(each) for each in on_gpu}) > 1:
            raise InputError(
                "Some processes can use a GPU and others cannot; run `doctor`, or train with --device cpu."
            )

    def tell(self, order: Order, progress: float = 0.0, closely: bool = False) -> None:
        self._broadcast(torch.tensor([order, progress, closely], dtype=torch.float64))

    def wait(self) -> tuple[Order, float, bool]:
        """Return the arguments of the first process' next call of `tell`; only in the others.

        Raises:
            ProcessLost: the first process has ended.
        """
        order, progress, closely = self._broadcast(torch.zeros(3, dtype=torch.float64)).tolist()
        return Order(int(order)), progress, bool(closely)

    def tell_state(self, state: dict[str, Any]) -> None:
        self.tell(Order.STATE)
        with _connected():
            self._distributed.broadcast_object_list([state], 0, device=torch.device("cpu"))

    def receive(self) -> dict[str, Any]:
        """Return the state that the first process has told to receive; only in the others.

        Raises:
            ProcessLost: the first process has ended.
        """
        received: list[Any] = [None]
        with _connected():
            self._distributed.broadcast_object_list(received, 0, device=torch.device("cpu"))
        return received[0]

    def _broadcast(self, values: torch.Tensor) -> torch.Tensor:
        with _connected():
            self._distributed.broadcast(values, 0)
        return values

    def exchange(self, tensors: Sequence[torch.Tensor]) -> list[Sequence[torch.Tensor]]:
        raw = [tensor.detach().contiguous().flatten().view(torch.uint8) for tensor in tensors]
        lengths = [torch.zeros(len(raw), dtype=torch.int64) for _ in range(self.size)]
        with _connected():
            self._distributed.all_gather(lengths, torch.tensor([len(part) for part in raw]))
        longest = max(sum(map(_aligned, each.tolist())) for each in lengths)
        message = torch.zeros(longest, dtype=torch.uint8, device=self._device if self._by_nccl else "cpu")
        for part, start in zip(raw, _starts([len(part) for part in raw]), strict=True):
            message[start : start + len(part)] = part
        messages = [torch.empty_like(message) for _ in range(self.size)]
        with _connected():
            self._distributed.all_gather(messages, message)
        return [
            _tensors_in(each.to(self._device), own.tolist(), tensors)
            for each, own in zip(messages, lengths, strict=True)
        ]

    def close(self) -> None:
        try:
            if self.rank == 0:
                self.tell(Order.END)
            self._distributed.destroy_process_group()
        except (ProcessLost, RuntimeError):
            pass  # They have ended already.


def _aligned(length: int) -> int:
    return -(-length // _ALIGNMENT) * _ALIGNMENT


def _starts(lengths: Sequence[int]) -> list[int]:
    """Return where parts of these lengths, in bytes, begin in a message."""
    return [0, *itertools.accumulate(map(_aligned, lengths))][: len(lengths)]


def _tensors_in(message: torch.Tensor, lengths: Sequence[int], likes: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    """Return the tensors in a message, given their lengths in bytes, and tensors of the same types and rows."""
    return [
        message[start : start + length].view(like.dtype).view(-1, *like.shape[1:])
        for start, length, like in zip(_starts(lengths), lengths, likes, strict=True)
    ]


@contextmanager
def _connected() -> Iterator[None]:
    """Raise ProcessLost where torch.distributed reports that a connection has ended."""
    try:
        yield
    except RuntimeError as error:
        if devices.is_out_of_memory(error):
            raise
        raise ProcessLost(_LOST) from error


def connect(device: torch.device) -> Team:
    """Connect the processes that torchrun has started; waits for all of them.

    Args:
        device: the device of this process.

    Returns:
        `Processes`, or a `Team` of one where torchrun has started no others.

    Raises:
        InputError: not all of them can use a GPU.
        ProcessLost: another process has ended.
    """
    return Processes(device) if processes() > 1 else Team()


def processes() -> int:
    """Return how many processes torchrun has started; 1 without torchrun."""
    # Others set WORLD_SIZE, too.
    return int(os.environ.get("WORLD_SIZE", 1)) if "LOCAL_WORLD_SIZE" in os.environ else 1


def processes_here() -> int:
    """Return how many of these processes share this machine."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", 1))


def is_follower() -> bool:
    """Return whether torchrun has started this process, and it is not the first one."""
    return processes() > 1 and os.environ.get("RANK", "0") != "0"


def choose_gpu() -> None:
    """Let each process use a GPU of its own, if torch sees any.

    Raises:
        InputError: there are fewer GPUs than processes.
    """
    gpus, number = torch.cuda.device_count(), int(os.environ.get("LOCAL_RANK", 0))
    if processes_here() == 1 or not gpus:
        return
    if processes_here() > gpus:
        raise InputError(
            f"There are {gpus} GPUs for {processes_here()} processes; use torchrun with --nproc-per-node {gpus}, or "
            "--device cpu."
        )
    torch.cuda.set_device(number)
