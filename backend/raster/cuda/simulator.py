"""Execution of CUDA kernels as Python on the CPU, with numba's simulator but a faster launcher.

numba's own launcher runs all threads of a block concurrently and polls them at each barrier, which takes about 20 ms
each. Here, one thread runs at a time, up to the next barrier; then the next thread runs. After each barrier, the order
of the threads is reversed, so that a kernel with a missing barrier produces a wrong result.
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
    """Run all blocks sequentially; arguments are NumPy arrays, tuples of them, and scalars."""
    has_barriers = bool(_BARRIERS & set(function.__code__.co_names))
    for block in range(blocks):
        module = FakeCUDAModule((blocks, 1, 1), (threads, 1, 1), 0)
        module._shared = _Shared()
        with swapped_cuda_module(function, module):
            if has_barriers:
                _Block(lambda: function(*arguments), block, threads).run()
            else:
                _Block(lambda: _run_sequentially(function, threads, arguments), block, 1).run()


class _Shared:
    """Shared memory of a block: one array for each source line that allocates one, initialized with garbage values."""

    def __init__(self) -> None:
        self._arrays: dict[int, np.ndarray] = {}

    def array(self, shape: Any, dtype: Any, alignment: int | None = None) -> np.ndarray:  # noqa: ARG002 - as numba's
        line = sys._getframe(1).f_lineno
        if line not in self._arrays:
            garbage = np.nan if np.issubdtype(dtype, np.floating) else np.iinfo(dtype).max
            self._arrays[line] = np.full(shape, garbage, dtype)
        return self._arrays[line]


class _Thread(threading.Thread):
    """A thread with the interface that the simulated `cuda` module expects; reused for all blocks."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.turn = threading.Lock()
        self.turn.acquire()
        self.start()

    def begin(self, index: int, block: int, owner: _Block, work: Callable[[], Any]) -> _Thread:
        self.threadIdx, self.blockIdx = Dim3(index, 0, 0), Dim3(block, 0, 0)
        self.owner, self.work, self.index = owner, work, index
        return self

    def run(self) -> None:
        # As on a GPU, divisions by zero and overflows raise no errors.
        with np.errstate(all="ignore"):
            while True:
                self.turn.acquire()
                try:
                    if not self.owner.failure:
                        self.work()
                except BaseException as failure:
                    self.owner.failure = self.owner.failure or failure
                self.owner.finish()

    def syncthreads(self) -> None:
        self.owner.reach_barrier()
        self.turn.acquire()
        if self.owner.failure:
            raise SystemExit

    def _vote(self, value: Any) -> np.ndarray:
        self.owner.votes[self.index] = bool(value)
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
    """Runs the threads of a block alternately."""

    def __init__(self, work: Callable[[], Any], block: int, threads: int) -> None:
        self.failure: BaseException | None = None
        self.votes = np.zeros(threads, bool)
        self.done = threading.Lock()
        self.done.acquire()
        while len(_THREADS) < threads:
            _THREADS.append(_Thread())
        self.waiting = [_THREADS[i].begin(i, block, self, work) for i in range(threads)]
        self.at_barrier: list[_Thread] = []

    def run(self) -> None:
        self.waiting[0].turn.release()
        self.done.acquire()
        if self.failure:
            raise self.failure

    def reach_barrier(self) -> None:
        """Suspend the running thread at a barrier."""
        self.at_barrier.append(self.waiting.pop(0))
        self._next()

    def finish(self) -> None:
        """Remove the running thread, which has finished."""
        self.waiting.pop(0)
        self._next()

    def _next(self) -> None:
        if not self.waiting:
            self.waiting, self.at_barrier = self.at_barrier[::-1], []
        if self.waiting:
            self.waiting[0].turn.release()
        else:
            self.done.release()


def _run_sequentially(function: Callable[..., Any], threads: int, arguments: tuple) -> None:
    thread = threading.current_thread()
    for index in range(threads):
        thread.threadIdx = Dim3(index, 0, 0)  # type: ignore[attr-defined]
        function(*arguments)
