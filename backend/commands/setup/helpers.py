"""Processes that compile parts of the kernels at the same time; others then load them from the cache on disk.

Numba compiles one function at a time in a process. `python -m backend.commands.setup.helpers PART FOLDER` compiles a
part, with its files in a folder that is empty or does not exist.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType

import numba
import psutil
import torch

from ...raster import compile_kernels
from ...shared.events import Reporter
from .small_scene import SmallScene

DISCS, MESHES = "discs", "meshes"
"""The parts: what needs no other kernels, and what needs those of 3D Gaussians."""

_ROOT = Path(__file__).parents[3]
_MEMORY = 3e9
"""Bytes that two helpers need, with some room for others."""
_POLLED_EVERY, _LONGEST = 0.3, 900.0
"""Seconds between two looks at a helper, and after which it is not waited for."""


class Helpers:
    """Helper processes, which are ended with the context; without a second thread or enough memory, there are none.

    Args:
        scratch: A folder for their files.
    """

    def __init__(self, scratch: Path) -> None:
        self._scratch = scratch
        self._useful = numba.get_num_threads() > 1 and psutil.virtual_memory().available > _MEMORY
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Helpers:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for process in self._processes.values():
            process.kill()
            process.wait()

    def begin(self, part: str) -> None:
        """Begin to compile a part."""
        if self._useful:
            command = [sys.executable, "-m", "backend.commands.setup.helpers", part, str(self._scratch / part)]
            quiet = subprocess.DEVNULL
            with contextlib.suppress(OSError):
                self._processes[part] = subprocess.Popen(command, cwd=_ROOT, stdin=quiet, stdout=quiet, stderr=quiet)

    def wait(self, part: str, reporter: Reporter) -> None:
        """Wait until a part is compiled, if it was begun; what a helper fails at is left to this process.

        Args:
            part: The part.
            reporter: Its progress is called repeatedly, so that it can stop the command.
        """
        process, until = self._processes.get(part), time.monotonic() + _LONGEST
        while process is not None and process.poll() is None and time.monotonic() < until:
            reporter.progress(0, 1)
            time.sleep(_POLLED_EVERY)


def compile_part(part: str, scratch: Path) -> None:
    """Compile the kernels of a part for the CPU, with files in a folder that is empty or does not exist."""
    device = torch.device("cpu")
    scene = SmallScene(scratch, device)
    if part == DISCS:
        compile_kernels(device, primitives=("2d",))
        scene.match()
    else:
        scene.mesh(scene.start())


if __name__ == "__main__":
    compile_part(sys.argv[1], Path(sys.argv[2]))
