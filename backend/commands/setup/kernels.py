"""Compilation of all kernels before a training's time is measured, once per machine."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from pathlib import Path
from typing import Any

import llvmlite.binding
import numba
import torch

from ...gpu.emulator import emulated
from ...gpu.kernel import digest_of_sources
from ...raster import compile_kernels, devices
from ...raster.kernel import digest_up_to
from ...shared.events import Reporter
from ...shared.stopping import StoppingReporter
from .helpers import DISCS, MESHES, Helpers
from .small_scene import SmallScene

PART = "kernels"
"""Name of the compilation among the parts of a command."""

_SECONDS = 60.0
"""Typical time of a compilation."""
_PROGRESS_FRACTIONS = {
    "gaussians": 0.3,
    "train": 0.5,
    "discs": 0.06,
    "match": 0.01,
    "meshes": 0.06,
    "fuse": 0.03,
    "refine": 0.02,
    "bake": 0.02,
}
"""Fractions of its time with helpers, for the progress, between those of an idle and a busy computer."""
_FIRST_STEP = 0.65
"""Fraction of the time of the training until its first step is done, which compiles most."""


def kernel_seconds(device: torch.device) -> float:
    """Return how long `ensure_kernels` is expected to take."""
    return 0.0 if _are_ready(device) else _SECONDS


def ensure_kernels(reporter: StoppingReporter, device: torch.device) -> None:
    """Compile the kernels of a device, unless an earlier run did; an emulated GPU needs no compilation.

    Args:
        reporter: Receives status and progress; may stop the compilation.
        device: The device to compile for.

    Raises:
        Cancelled: The user stopped the command.
    """
    if not _are_ready(device):
        try_kernels(reporter, device)


def try_kernels(reporter: StoppingReporter, device: torch.device) -> None:
    """Compile all kernels of a device and run them in a training of a few splats."""
    reporter.begin(PART, "Compiling kernels, which later jobs use, too")
    steps = _Steps(reporter)
    mark = _mark(device)
    # Without a writable cache the mark is not needed, and helpers are of no use.
    with contextlib.suppress(OSError):
        mark.parent.mkdir(parents=True, exist_ok=True)
    helped = device.type == "cpu" and not _are_ready(device) and os.access(mark.parent, os.W_OK)
    scratch = tempfile.TemporaryDirectory(prefix="objectgs-kernels-", ignore_cleanup_errors=True)
    with scratch as folder, Helpers(Path(folder)) as helpers:
        if helped:
            helpers.begin(DISCS)
        compile_kernels(device, steps.step("gaussians").progress, ("3d",))
        if helped:
            helpers.begin(MESHES)
        scene = SmallScene(Path(folder) / "scene", device)
        trainer = scene.train(steps.step("train", _FIRST_STEP), reporter.stop)
        helpers.wait(DISCS, steps.step("discs"))
        compile_kernels(device, steps.progress, ("2d",))
        scene.train_discs()
        scene.match(steps.step("match").progress)
        helpers.wait(MESHES, steps.step("meshes"))
        scene.mesh(trainer, steps.step)
    with contextlib.suppress(OSError):
        mark.touch()


class _Steps(Reporter):
    """Converts the progress of a step of the compilation to that of all."""

    def __init__(self, reporter: Reporter) -> None:
        self._reporter, self._before, self._fraction, self._first = reporter, 0.0, 0.0, 0.0

    def step(self, step: str, first: float = 0.0) -> _Steps:
        """Begin a step, of which a fraction is done with its first progress, and return self."""
        self._before += self._fraction
        self._fraction, self._first = _PROGRESS_FRACTIONS[step], first
        self.progress(0, 1)
        return self

    def progress(self, done: float, total: float, **_: Any) -> None:
        share = done / max(total, 1e-9)
        share = self._first + (1 - self._first) * share if done else 0.0
        self._reporter.progress(self._before + self._fraction * share, 1.0)


def _are_ready(device: torch.device) -> bool:
    """Return whether an earlier run compiled the kernels; an emulated GPU needs no compilation."""
    return emulated() or _mark(device).exists()


def _mark(device: torch.device) -> Path:
    """Return the path of the file that marks the kernels of these sources as compiled for a device."""
    processor = f"{llvmlite.binding.get_host_cpu_name()} {devices.name_of(device)}"
    if device.type != "cpu":
        processor += f" {torch.__version__} {digest_of_sources()}"
    return path_beside_kernels(".ready", digest_up_to("stereo"), numba.__version__, processor)


def path_beside_kernels(suffix: str, *parts: str) -> Path:
    """Return the path of a file beside numba's cache, whose name depends on the folder of the sources, as numba's cache
    does, and on `parts`."""
    sources = Path(__file__).resolve().parents[2]
    folder = Path(numba.config.CACHE_DIR or sources / "raster" / "__pycache__")
    return folder / f"objectgs-{hashlib.sha256(' '.join((str(sources), *parts)).encode()).hexdigest()[:16]}{suffix}"
