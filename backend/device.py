"""Where is computed: on the processor, or on an NVIDIA GPU through CUDA, and why not there.

Work goes to the GPU by its tensors: functions that have a version for each ask `on_gpu` about one of them. In numba's
simulator (NUMBA_ENABLE_CUDASIM=1) tensors stay in the processor's memory, and everything else goes the GPU's way.
"""

from __future__ import annotations

import functools
import importlib.util
from typing import Any

import numpy as np
import torch
from numba import config

from .protocol import InputError

CHOICES = ("auto", "cpu", "cuda")

LEAST_MEMORY = 1e9
"""Bytes of GPU memory that must be free: CUDA itself and torch's libraries take about half of them."""

_SAID_WHEN_FULL = ("CUDA_ERROR_OUT_OF_MEMORY", "CUDA error: out of memory", "CUBLAS_STATUS_ALLOC_FAILED")
"""By numba's driver, CUDA's own calls and its library for matrices."""

CPU = torch.device("cpu")


def pick(asked: str) -> torch.device:
    """The device for `asked`: cpu, cuda, or auto (cuda where it works); InputError where cuda does not."""
    if asked not in CHOICES:
        raise ValueError(f"the device is {asked!r}, expected one of {CHOICES}")
    why_not = None if asked == "cpu" else why_not_cuda()
    if asked == "cuda" and why_not is not None:
        raise InputError(why_not)
    if asked == "cpu" or why_not is not None or simulated():
        return CPU
    return torch.device("cuda", torch.cuda.current_device())


def simulated() -> bool:
    """Whether numba runs CUDA kernels in its simulator."""
    return bool(config.ENABLE_CUDASIM)


def on_gpu(tensor: torch.Tensor) -> bool:
    """Whether work on this tensor goes the GPU's way: torch and CUDA kernels instead of numba's kernels on arrays."""
    return tensor.is_cuda or simulated()


def name_of(device: torch.device) -> str:
    """cpu, or cuda with the GPU's name."""
    return f"cuda ({torch.cuda.get_device_name(device)})" if device.type == "cuda" else "cpu"


def host(values: torch.Tensor | np.ndarray) -> np.ndarray:
    """A tensor of any device as an array; on the processor both share their memory."""
    return values.detach().cpu().numpy() if isinstance(values, torch.Tensor) else values


def upload(values: np.ndarray, like: torch.Tensor | torch.device) -> torch.Tensor:
    """An array as a tensor on a device (or that of a tensor), without waiting for the device to be done with others."""
    device = like.device if isinstance(like, torch.Tensor) else like
    return torch.from_numpy(values).to(device, non_blocking=True)


def is_out_of_memory(error: BaseException) -> bool:
    """Whether this says that the GPU's memory is full."""
    return isinstance(error, torch.cuda.OutOfMemoryError) or any(words in str(error) for words in _SAID_WHEN_FULL)


@functools.cache
def why_not_cuda() -> str | None:
    """One sentence that says why CUDA cannot be used here and what would help; None where it can."""
    if simulated():
        return None
    return _lacking_build() or _lacking_driver() or _lacking_gpu() or _lacking_kernels()


def _lacking_build() -> str | None:
    if getattr(torch.version, "hip", None):
        return "This PyTorch is built for AMD GPUs, which ObjectGS cannot use; install a build for CUDA."
    if torch.version.cuda is None:
        return (
            f"This PyTorch ({torch.__version__}) is built without CUDA; set the backend up again for an NVIDIA GPU, or "
            "install a build of PyTorch for CUDA."
        )
    if importlib.util.find_spec("numba_cuda") is None:
        return "The package numba-cuda is missing; install it with pip install -r requirements/cuda.txt."
    return None


def _lacking_driver() -> str | None:
    try:
        torch.cuda.init()
    except (RuntimeError, AssertionError) as error:
        return sentence_for(str(error), torch.version.cuda)
    return None if torch.cuda.device_count() else sentence_for("No CUDA GPUs are available", torch.version.cuda)


def sentence_for(error: str, toolkit: str | None) -> str:
    """What torch says when CUDA does not start, as a sentence that helps; toolkit: the CUDA that torch is built for."""
    said = error.lower()
    if "driver on your system is too old" in said or "driver version is insufficient" in said:
        return (
            f"The NVIDIA driver is too old for CUDA {toolkit}, which this PyTorch is built for; install a newer driver "
            "from nvidia.com, or a PyTorch for an older CUDA."
        )
    if "no nvidia driver" in said:
        return "There is no NVIDIA driver on this computer; install the one for your GPU from nvidia.com."
    if "no cuda gpus" in said or "no cuda-capable device" in said:
        return "The NVIDIA driver shows no GPU that may be used; look at nvidia-smi and at CUDA_VISIBLE_DEVICES."
    first = error.strip().partition("\n")[0].rstrip(".") or "it did not say why"
    return f"CUDA does not start on this computer ({first}); restarting it, or a newer NVIDIA driver, may help."


def _lacking_gpu() -> str | None:
    name = torch.cuda.get_device_name()
    try:
        if float(torch.ones(1, device="cuda").sum()) != 1.0:
            return f"The GPU {name} adds up wrongly; restart the computer."
        free, total = torch.cuda.mem_get_info()
    except RuntimeError as error:
        if "no kernel image" in str(error):
            major, minor = torch.cuda.get_device_capability()
            return (
                f"This PyTorch has no code for the GPU {name} (compute capability {major}.{minor}); install a build of "
                "PyTorch that has."
            )
        free, total = (0, 0) if is_out_of_memory(error) else (-1, -1)
        if free < 0:
            return sentence_for(str(error), torch.version.cuda)
    return short_of_memory(name, free, total)


def short_of_memory(name: str, free: float, total: float) -> str | None:
    """A sentence where the GPU has fewer than LEAST_MEMORY bytes free, of `total`."""
    if free >= LEAST_MEMORY:
        return None
    if 0 < total < LEAST_MEMORY:
        return f"The GPU {name} has {total / 1e9:.1f} GB of memory, and {LEAST_MEMORY / 1e9:.0f} GB are needed."
    return (
        f"The GPU {name} has {free / 1e9:.1f} GB of memory free, and {LEAST_MEMORY / 1e9:.0f} GB are needed; close "
        "programs that use it."
    )


def _lacking_kernels() -> str | None:
    """Compile and run the smallest kernel: numba-cuda brings a toolkit of its own, which the driver must know too."""
    try:
        from numba import cuda

        @cuda.jit
        def mark(out: Any) -> None:
            out[0] = 1

        out = torch.zeros(1, dtype=torch.int32, device="cuda")
        mark[1, 1](cuda.as_cuda_array(out))
        cuda.synchronize()
        if int(out[0]) != 1:
            return "A CUDA kernel ran without effect; restart the computer."
    except Exception as error:  # Whatever it is, the processor still works.
        first = f"{type(error).__name__}: {str(error).strip()}".partition("\n")[0].rstrip(".: ")
        if "PTX" in str(error) and "version" in str(error).lower():
            return "The NVIDIA driver is too old for the installed numba-cuda; install a newer driver from nvidia.com."
        return f"numba-cuda cannot run a kernel here ({first}); install it with pip install -r requirements/cuda.txt."
    return None
