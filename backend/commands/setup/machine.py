"""The machine that a command runs on: versions, cores, threads and memory."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numba
import psutil
import torch

from ...raster import devices
from ...shared.version import __version__
from ...training.processes.team import is_follower, processes_here

_PACKAGES = ("torch", "numpy", "numba", "pycolmap", "scikit-image", "manifold3d", "xatlas")

CGROUPS = Path("/sys/fs/cgroup")
"""Where Linux tells the limits of containers and of jobs on clusters."""


def set_threads(threads: int | None) -> None:
    """Set the number of threads of kernels and torch; None for this process' share of the cores that it may use."""
    count = max(min(threads or cores() // processes_here(), numba.config.NUMBA_NUM_THREADS), 1)
    numba.set_num_threads(count)
    torch.set_num_threads(count)


def owns_stdin() -> bool:
    """Return whether this process reads standard input, which all processes of a training have in common."""
    return not is_follower()


@contextmanager
def threads_of_all_processes() -> Iterator[None]:
    """Use the threads of all processes that torchrun has started, while the others wait."""
    own = numba.get_num_threads()
    set_threads(own * processes_here())
    try:
        yield
    finally:
        set_threads(own)


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def machine_facts(device: torch.device) -> dict[str, Any]:
    """Return versions and hardware, to store with measurements; `device` trains and renders the splats."""
    gpu = {}
    if device.type == "cuda":
        gpu = {
            "gpu_memory_gb": round(torch.cuda.get_device_properties(device).total_memory / 1e9, 1),
            "cuda": torch.version.hip or torch.version.cuda,
        }  # fmt: skip
    return {
        "objectgs": __version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "cores": cores(),
        "threads": numba.get_num_threads(),
        "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
        "device": devices.name_of(device),
        **gpu,
        **{name: importlib.metadata.version(name) for name in _PACKAGES},
    }


def free_memory() -> float:
    """Return the bytes that this process may have: what it has, what is free, and no more than its control groups."""
    free = psutil.virtual_memory().available + psutil.Process().memory_info().rss
    own = "/"
    with suppress(OSError):
        lines = Path("/proc/self/cgroup").read_text().splitlines()
        own = next((line[3:] for line in lines if line.startswith("0::")), own)
    here = CGROUPS / own.lstrip("/")
    for folder in (here, *here.parents):
        # It has no number without a limit, and no such file outside of control groups.
        with suppress(OSError, ValueError):
            free = min(free, int((folder / "memory.max").read_text()))
    return float(free)


def peak_mb() -> float:
    """Return the peak memory of this process so far, in MB."""
    if sys.platform == "win32":
        return round(psutil.Process().memory_info().peak_wset / 1e6, 1)
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak * (1 if sys.platform == "darwin" else 1024) / 1e6, 1)
