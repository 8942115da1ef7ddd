"""Selection of the compute device, the CPU or a GPU through CUDA or HIP, and diagnosis if no GPU is available.

Functions with an implementation for each device call `on_gpu` with one of their tensors. If a GPU is emulated
(OBJECTGS_EMULATE_GPU=1), tensors stay in host memory, and the GPU implementations are used.
"""

from __future__ import annotations

import functools
import sys

import numpy as np
import torch

from ..gpu.emulator import emulated
from ..shared.errors import InputError

CHOICES = ("auto", "cpu", "cuda")

MIN_FREE_MEMORY = 1e9
"""Bytes of GPU memory that must be free; CUDA itself and torch's libraries use about half of them."""

_MOST_MEMORY = 0.95
"""Largest fraction of the GPU's free memory that is used where it is limited."""

_OUT_OF_MEMORY_TEXTS = (
    "CUDA_ERROR_OUT_OF_MEMORY", "CUDA error: out of memory", "HIP error: out of memory", "CUBLAS_STATUS_ALLOC_FAILED",
    "HIPBLAS_STATUS_ALLOC_FAILED",
)  # fmt: skip
"""Error texts of the driver, the runtime and the library of matrix products, of NVIDIA and AMD."""

_FAILURES = ("CUDA error", "HIP error", "CUDA_ERROR_", "hipError")
"""Beginnings of error texts of a GPU that failed while it computed."""

_LONGEST_REASON = 300
"""Characters of an error that are shown."""

_NO_DRIVER = "There is no NVIDIA driver on this computer; install the one for your GPU from nvidia.com."
_NO_GPU = "The NVIDIA driver shows no GPU that may be used; check nvidia-smi and CUDA_VISIBLE_DEVICES."

CPU = torch.device("cpu")


def pick(requested: str) -> torch.device:
    """Select the device to compute on.

    Args:
        requested: "cpu", "cuda", or "auto" (CUDA if available, otherwise the CPU).

    Returns:
        The torch device; if a GPU is emulated, always the CPU.

    Raises:
        InputError: `requested` is "cuda" and CUDA is not available.
        ValueError: `requested` is not in CHOICES.
    """
    if requested not in CHOICES:
        raise ValueError(f"the device is {requested!r}, expected one of {CHOICES}")
    why_not = None if requested == "cpu" else why_not_cuda()
    if requested == "cuda" and why_not is not None:
        raise InputError(why_not)
    if requested == "cpu" or why_not is not None or emulated():
        return CPU
    return torch.device("cuda", torch.cuda.current_device())


def on_gpu(tensor: torch.Tensor) -> bool:
    """Return whether a tensor is processed by torch and GPU kernels instead of numba's kernels on arrays."""
    return tensor.is_cuda or emulated()


def name_of(device: torch.device) -> str:
    """Return the display name of a device: "cpu", or "cuda" or "hip" (of AMD) with the GPU's name."""
    if device.type != "cuda":
        return device.type
    return f"{'hip' if torch.version.hip else 'cuda'} ({torch.cuda.get_device_name(device)})"


def host(values: torch.Tensor | np.ndarray) -> np.ndarray:
    """Copy a tensor to a NumPy array.

    Args:
        values: a tensor on any device, or an array.

    Returns:
        The array; it shares memory with a tensor in host memory.
    """
    return values.detach().cpu().numpy() if isinstance(values, torch.Tensor) else values


def upload(values: np.ndarray, like: torch.Tensor | torch.device) -> torch.Tensor:
    """Copy an array to a device asynchronously.

    Args:
        values: the array.
        like: the device, or a tensor on it.

    Returns:
        The tensor on the device.
    """
    device = like.device if isinstance(like, torch.Tensor) else like
    return torch.from_numpy(values).to(device, non_blocking=True)


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error of torch or of a kernel means that the GPU's memory is full."""
    return isinstance(error, torch.cuda.OutOfMemoryError) or any(words in str(error) for words in _OUT_OF_MEMORY_TEXTS)


def is_failure(error: BaseException) -> bool:
    """Return whether an error of torch or of a kernel means that a GPU has failed while it computed."""
    return isinstance(error, RuntimeError) and any(words in str(error) for words in _FAILURES)


@functools.cache
def limit_memory(device: torch.device) -> None:
    """Let torch say on Windows, too, that a GPU's memory is full, once in a process.

    NVIDIA's driver would go on in the computer's memory there, many times slower and without an error.
    """
    if sys.platform == "win32":
        free, total = torch.cuda.mem_get_info(device)
        most = _MOST_MEMORY * (free + torch.cuda.memory_reserved(device)) / total
        torch.cuda.set_per_process_memory_fraction(min(most, 1.0), device)


def refused_gpu() -> str | None:
    """Return why a GPU that this PyTorch could use is not used, as `why_not_cuda`; None without such a GPU."""
    if emulated() or _problem_with_build():
        return None
    reason = why_not_cuda()
    return None if reason in (_NO_DRIVER, _NO_GPU) else reason


@functools.cache
def why_not_cuda() -> str | None:
    """Explain why CUDA cannot be used on this computer.

    Returns:
        One sentence with the reason and a remedy; None if CUDA works.
    """
    if emulated():
        return None
    return _problem_with_build() or _problem_with_driver() or _problem_with_gpu() or _problem_with_kernels()


def _problem_with_build() -> str | None:
    if torch.version.cuda is None and getattr(torch.version, "hip", None) is None:
        return (
            f"This PyTorch ({torch.__version__}) is built without CUDA; set the backend up again for an NVIDIA GPU, or "
            "install a build of PyTorch for CUDA."
        )
    return None


def _problem_with_driver() -> str | None:
    try:
        torch.cuda.init()
    except Exception as error:  # Of several types; for any of them, the CPU can be used instead.
        return explain_cuda_error(str(error), torch.version.cuda)
    return None if torch.cuda.device_count() else explain_cuda_error("No CUDA GPUs are available", torch.version.cuda)


def explain_cuda_error(error: str, toolkit: str | None) -> str:
    """Explain torch's error if CUDA does not start; toolkit: the CUDA version that torch was built for."""
    text = error.lower()
    if "driver on your system is too old" in text or "driver version is insufficient" in text:
        return (
            f"The NVIDIA driver is too old for CUDA {toolkit}, which this PyTorch is built for; install a newer driver "
            "from nvidia.com, or a PyTorch for an older CUDA."
        )
    if "no nvidia driver" in text:
        return _NO_DRIVER
    if "no cuda gpus" in text or "no hip gpus" in text or "no cuda-capable device" in text:
        return _NO_GPU
    first = error.strip().partition("\n")[0].rstrip(".") or "no reason was given"
    return f"CUDA does not start on this computer ({first}); restarting it, or a newer NVIDIA driver, may help."


def _problem_with_gpu() -> str | None:
    name = "of this computer"
    try:
        name = torch.cuda.get_device_name()
        if float(torch.ones(1, device="cuda").sum()) != 1.0:
            return f"The GPU {name} computes wrong results; restart the computer."
        free, total = torch.cuda.mem_get_info()
    except Exception as error:  # As above.
        if "no kernel image" in str(error):
            major, minor = torch.cuda.get_device_capability()
            return (
                f"This PyTorch has no code for the GPU {name} (compute capability {major}.{minor}); install a build of "
                "PyTorch that has."
            )
        free, total = (0, 0) if is_out_of_memory(error) else (-1, -1)
        if free < 0:
            return explain_cuda_error(str(error), torch.version.cuda)
    return explain_low_memory(name, free, total)


def explain_low_memory(name: str, free: float, total: float) -> str | None:
    """Explain that fewer than MIN_FREE_MEMORY of the GPU's `total` bytes are free; None if there is enough memory."""
    if free >= MIN_FREE_MEMORY:
        return None
    if 0 < total < MIN_FREE_MEMORY:
        return f"The GPU {name} has {total / 1e9:.1f} GB of memory, and {MIN_FREE_MEMORY / 1e9:.0f} GB are needed."
    return (
        f"The GPU {name} has {free / 1e9:.1f} GB of memory free, and {MIN_FREE_MEMORY / 1e9:.0f} GB are needed; close "
        "programs that use it."
    )


def _problem_with_kernels() -> str | None:
    """Compile and run a small kernel, since torch has the compiler of kernels in a library of its own."""
    try:
        from .gpu.kernels import raster_kernel
        from .splats import SPLAT_COLUMNS

        unseen = torch.full((1, SPLAT_COLUMNS), -1.0, device="cuda")
        keys = torch.zeros(1, dtype=torch.int64, device="cuda")
        raster_kernel("write_keys").for_each(1, unseen, 1, keys)
        if int(keys[0]) != 2**63 - 1:
            return "A kernel ran on the GPU without effect; restart the computer."
    except Exception as error:  # For any error, the CPU can be used instead.
        # The compiler names the cause in further lines; those of torch's errors advise programmers.
        text = str(error).strip().partition("\n")[0] if is_failure(error) else str(error)
        reason = " ".join(f"{type(error).__name__}: {text}".split())[:_LONGEST_REASON].rstrip(".: ")
        return f"Kernels do not run on this GPU ({reason}); install a newer driver, or set the backend up again."
    return None
