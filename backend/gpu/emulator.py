"""Compilation of kernels by the C++ compiler of the system, and their execution on the CPU, for tests without a GPU.

See source/emulator.h. It needs g++ on Linux, with glibc.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

from ..shared.formats.atomic import atomic_path

_COMMAND = (
    "g++", "-std=c++17", "-O2", "-fPIC", "-shared", "-w", "-x", "c++", "-ffp-contract=off", "-U_FORTIFY_SOURCE",
)  # fmt: skip


def emulated() -> bool:
    """Return whether a GPU is emulated on the CPU, for tests."""
    return os.environ.get("OBJECTGS_EMULATE_GPU") == "1"


def load(name: str, source: str) -> Callable[[Any, int, int], None]:
    """Compile a kernel.

    Args:
        name: the kernel.
        source: its complete source text.

    Returns:
        A function with the arguments (pointers to the arguments, blocks, threads per block) that runs the kernel and
        raises RuntimeError if only a part of a block's threads reaches a barrier.
    """
    text = f"{source}\nEMULATE({name})\n"
    digest = hashlib.sha256(" ".join((*_COMMAND, text)).encode()).hexdigest()[:24]
    library = Path(numba.config.CACHE_DIR or tempfile.gettempdir()) / f"objectgs-{name}-{digest}.so"
    if not library.exists():
        library.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(library) as made:
            subprocess.run([*_COMMAND, "-o", made, "-"], input=text, text=True, check=True)
    run = ctypes.CDLL(str(library)).launch
    run.restype = ctypes.c_bool

    def launch(pointers: Any, blocks: int, threads: int) -> None:
        if not run(pointers, blocks, threads):
            raise RuntimeError(f"not all threads of a block of {name} reach the same barrier")

    return launch
