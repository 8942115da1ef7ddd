"""Compilation and launch of CUDA kernels with numba-cuda.

`cuda_kernel` compiles a function for an NVIDIA GPU; `launch` runs it on torch tensors, in torch's current stream,
without copies or synchronization.

This module is imported only by code that runs on a GPU, so numba-cuda is optional. In numba's simulator
(NUMBA_ENABLE_CUDASIM=1), which requires only numba, the same kernels run as Python on tensors in host memory. A
kernel's module uses `from numba import cuda`; parts that would dominate the run time in the simulator should be
`device_function`s, which are compiled for the simulator.
"""

from __future__ import annotations

import functools
import math
import threading
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numba import cuda

from ..devices import simulated
from ..kernel import kernel, renew_with_layer

# Small images and few splats result in small grids; numba's warning about them is not helpful.
warnings.filterwarnings("ignore", message="Grid size .* will likely result in GPU under-utilization")

WARP = 32
ALL_LANES = 0xFFFFFFFF


def cuda_kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorate a CUDA kernel: numba.cuda.jit with a disk cache that is valid until dependencies change (see `kernel`).

    Args:
        options: passed to numba.cuda.jit, e.g. launch_bounds=256 for a kernel that is always launched with 256 threads.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        if simulated():
            return function
        dispatcher = cuda.jit(cache=True, **options)(function)
        renew_with_layer(dispatcher, function)
        return dispatcher

    return decorate


def device_function(function: Callable[..., Any]) -> Any:
    """Decorate a function that is inlined into the kernels that call it.

    It must not use `cuda`, since it is compiled for the CPU in the simulator. CUDA kernels can also call functions
    compiled by `backend.raster.kernel.kernel`.
    """
    if simulated():
        return kernel()(function)
    return cuda.jit(device=True, forceinline=True)(function)


def launch(function: Any, blocks: int, threads: int, *arguments: Any) -> None:
    """Launch a kernel with `blocks` blocks of `threads` threads; does nothing for 0 blocks.

    Args:
        function: the kernel.
        blocks: number of blocks.
        threads: threads per block.
        arguments: tensors (contiguous, at least one element, all on one device), tuples of tensors, and NumPy scalars
            of the types that the kernel expects.
    """
    if not blocks:
        return
    if simulated():
        from .simulator import run

        run(function, blocks, threads, tuple(_map_tensors(_host_array, a) for a in arguments))
        return
    function[blocks, threads, _stream(torch.cuda.current_stream().cuda_stream)](
        *(_map_tensors(_device_array, a) for a in arguments)
    )


def launch_for_each(function: Any, count: int, *arguments: Any) -> None:
    """Launch a kernel without shared memory with one thread for each of `count` elements.

    The thread index i is `cuda.grid(1)`; threads with i >= count must do nothing.
    """
    threads = min(128, WARP * math.ceil(count / WARP)) or WARP
    launch(function, math.ceil(count / threads), threads, *arguments)


def _map_tensors(convert: Callable[[torch.Tensor], Any], argument: Any) -> Any:
    if isinstance(argument, torch.Tensor):
        return convert(argument.detach())
    if isinstance(argument, tuple):
        return tuple(_map_tensors(convert, a) for a in argument)
    return argument


def _host_array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.numpy()


def _device_array(tensor: torch.Tensor) -> Any:
    return cuda.as_cuda_array(tensor, sync=False)


@functools.cache
def _stream(pointer: int) -> Any:
    return cuda.external_stream(pointer) if pointer else 0


# Functions that do not exist in the simulator, with replacements.

if simulated():

    def sync_warp() -> None:
        """Wait for the other threads of the warp."""
        threading.current_thread().syncthreads()  # type: ignore[attr-defined]

    @kernel()
    def any_in_warp(condition):  # noqa: ARG001 - the simulator has no warps
        """Return whether the condition may hold in a thread of the warp; if not, it holds in none."""
        return True

    @kernel()
    def exp2(x):
        """Return 2^x in float32."""
        return np.exp2(np.float32(x))

    @kernel()
    def reciprocal(x):
        """Return 1 / x in float32."""
        return np.float32(1.0) / np.float32(x)

else:
    from numba.cuda import libdevice

    @cuda.jit(device=True, forceinline=True)
    def sync_warp():
        """Wait for the other threads of the warp."""
        cuda.syncwarp(ALL_LANES)

    @cuda.jit(device=True, forceinline=True)
    def any_in_warp(condition):
        """Return whether the condition may hold in a thread of the warp; if not, it holds in none."""
        return cuda.any_sync(ALL_LANES, condition)

    @cuda.jit(device=True, forceinline=True)
    def exp2(x):
        """Return 2^x in float32, to 2 units in the last place."""
        return libdevice.exp2f(x)

    @cuda.jit(device=True, forceinline=True)
    def reciprocal(x):
        """Return 1 / x in float32, to 2 units in the last place; 1 / 0 is infinite."""
        return libdevice.fast_fdividef(np.float32(1.0), x)
