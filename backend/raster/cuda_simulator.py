"""Runs CUDA kernels as Python on the CPU: numba's simulator of threads and shared memory, with threads that take turns.

numba's own launcher lets all threads of a block run at once and polls them at every barrier, some 20 ms each. Here one
thread runs at a time, up to the next barrier; then the next one does. Every other time they go in the opposite order,
so that a kernel that lacks a barrier draws something wrong.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from numba.cuda.simulator.kernel import Dim3
from numba.cuda.simulator.kernelapi import FakeCUDAModule, swapped_cuda_module

_BARRIERS = {"syncthreads", "syncthreads_and", "syncthreads_count", "syncthreads_or", "sync_warp"}


def run(function: Callable[..., Any], blocks: int, threads: int, arguments: tuple) -> None:
    """One block after the other; arguments are NumPy arrays, tuples of them, and scalars."""
    meet = bool(_BARRIERS & set(function.__code__.co_names))
    for block in range(blocks):
        module = FakeCUDAModule((blocks, 1, 1), (threads, 1, 1), 0)
        module._shared = _Shared()
        with swapped_cuda_module(function, module):
            if meet:
                _Block(lambda: function(*arguments), block, threads).run()
            else:
                _Block(lambda: _one_after_the_other(function, threads, arguments), block, 1).run()


class _Shared:
    """Shared memory of a block: each line of a kernel that asks for an array has one; what it holds is of no use."""

    def __init__(self) -> None:
        self._arrays: dict[int, np.ndarray] = {}

    def array(self, shape: Any, dtype: Any, alignment: int | None = None) -> np.ndarray:
        line = sys._getframe(1).f_lineno
        if line not in self._arrays:
            useless = np.nan if np.issubdtype(dtype, np.floating) else np.iinfo(dtype).max
            self._arrays[line] = np.full(shape, useless, dtype)
        return self._arrays[line]


class _Thread(threading.Thread):
    """A thread as the simulated `cuda` module looks for it (the one that runs), kept for block after block."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.turn = threading.Lock()
        self.turn.acquire()
        self.start()

    def begin(self, place: int, block: int, owner: _Block, work: Callable[[], Any]) -> _Thread:
        self.threadIdx, self.blockIdx = Dim3(place, 0, 0), Dim3(block, 0, 0)
        self.owner, self.work, self.place = owner, work, place
        return self

    def run(self) -> None:
        # What a kernel divides by zero or overflows is for its guards, as on a GPU.
        with np.errstate(all="ignore"):
            while True:
                self.turn.acquire()
                try:
                    if not self.owner.failure:
                        self.work()
                except BaseException as failure:
                    self.owner.failure = self.owner.failure or failure
                self.owner.leave()

    def syncthreads(self) -> None:
        self.owner.pass_on()
        self.turn.acquire()
        if self.owner.failure:
            raise SystemExit

    def _vote(self, value: Any) -> np.ndarray:
        self.owner.votes[self.place] = bool(value)
        self.syncthreads()
        votes = self.owner.votes.copy()
        self.syncthreads()
        return votes

    def syncthreads_count(self, value: Any) -> int:
        return int(self._vote(value).sum())

    def syncthreads_and(self, value: Any) -> int:
        return int(self._vote(value).all())

    def syncthreads_or(self, value: Any) -> int:
        return int(self._vote(value).any())


_THREADS: list[_Thread] = []


class _Block:
    """Hands the turn from thread to thread."""

    def __init__(self, work: Callable[[], Any], block: int, threads: int) -> None:
        self.failure: BaseException | None = None
        self.votes = np.zeros(threads, bool)
        self.done = threading.Lock()
        self.done.acquire()
        while len(_THREADS) < threads:
            _THREADS.append(_Thread())
        self.waiting = [_THREADS[i].begin(i, block, self, work) for i in range(threads)]
        self.met: list[_Thread] = []

    def run(self) -> None:
        self.waiting[0].turn.release()
        self.done.acquire()
        if self.failure:
            raise self.failure

    def pass_on(self) -> None:
        """The first of those that wait has come to a barrier."""
        self.met.append(self.waiting.pop(0))
        self._next()

    def leave(self) -> None:
        """The first of those that wait has come to its end."""
        self.waiting.pop(0)
        self._next()

    def _next(self) -> None:
        if not self.waiting:
            self.waiting, self.met = self.met[::-1], []
        if self.waiting:
            self.waiting[0].turn.release()
        else:
            self.done.release()


def _one_after_the_other(function: Callable[..., Any], threads: int, arguments: tuple) -> None:
    thread = threading.current_thread()
    for place in range(threads):
        thread.threadIdx = Dim3(place, 0, 0)  # type: ignore[attr-defined]
        function(*arguments)
