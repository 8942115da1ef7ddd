"""The machine that a command runs on: its versions, cores, threads and memory."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
from typing import Any

import numba
import psutil
import torch

from .. import __version__, device

_PACKAGES = ("torch", "numpy", "numba", "pycolmap", "scikit-image", "manifold3d", "xatlas")


def set_threads(threads: int | None) -> None:
    """Use so many threads in kernels and in torch (None: every core that this process may use)."""
    count = max(min(threads or cores(), numba.config.NUMBA_NUM_THREADS), 1)
    numba.set_num_threads(count)
    torch.set_num_threads(count)


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def machine_facts(place: torch.device) -> dict[str, Any]:
    """What the figures were measured on; place: the device that splats are made and drawn on."""
    gpu = {}
    if place.type == "cuda":
        gpu = {
            "gpu_memory_gb": round(torch.cuda.get_device_properties(place).total_memory / 1e9, 1),
            "cuda": torch.version.cuda, "numba-cuda": importlib.metadata.version("numba-cuda"),
        }  # fmt: skip
    return {
        "objectgs": __version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "cores": cores(),
        "threads": numba.get_num_threads(),
        "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
        "device": device.name_of(place),
        **gpu,
        **{name: importlib.metadata.version(name) for name in _PACKAGES},
    }


def peak_mb() -> float:
    """Peak memory of this process so far."""
    if sys.platform == "win32":
        return round(psutil.Process().memory_info().peak_wset / 1e6, 1)
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / 1e6 if sys.platform == "darwin" else peak / 1e3, 1)
