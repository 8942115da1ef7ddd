"""Compilation of all kernels before a training's time is measured, once per machine."""

from __future__ import annotations

import contextlib
import hashlib
import tempfile
from pathlib import Path
from typing import Any

import llvmlite.binding
import numba
import numpy as np
import torch
from PIL import Image
from scipy import sparse

from ...capture import load_capture
from ...labels import vote as vote_points
from ...mesh.field.extract import extract
from ...mesh.field.fusion import fuse
from ...mesh.refine import refine
from ...mesh.surface import NoSurface, Surface
from ...mesh.texture.bake import bake_texture
from ...mesh.texture.unwrap import unwrap
from ...mesh.views import Views
from ...model.draw import draw
from ...pointing.random_walker import random_walker
from ...raster import compile_kernels, devices
from ...raster.kernel import digest_up_to
from ...shared.events import Reporter
from ...shared.reconstruction.folder import Reconstruction
from ...shared.stopping import StoppingReporter
from ...stereo.depth_maps import find_depth_maps
from ...training.budget import Budget
from ...training.settings import Settings
from ...training.trainer import Trainer

STEPS = 220
"""Takes a second or two, and includes growth, which occurs every 50 steps in the first half of the training."""
PART = "kernels"
"""Name of the compilation among the parts of a command."""

_SECONDS = 100.0
"""Typical time of a compilation."""
_PROGRESS_FRACTIONS = {
    "render": 0.3,
    "step": 0.3,
    "train": 0.14,
    "fuse": 0.04,
    "refine": 0.02,
    "bake": 0.1,
    "match": 0.1,
}
"""Fractions of its time, for the progress."""


def kernel_seconds(device: torch.device) -> float:
    """Return how long `ensure_kernels` is expected to take."""
    return 0.0 if _are_ready(device) else _SECONDS


def ensure_kernels(reporter: StoppingReporter, device: torch.device) -> None:
    """Compile the kernels of a device, unless an earlier run did; the simulator needs no compilation.

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
    compile_kernels(device, steps.step("render").progress)
    with tempfile.TemporaryDirectory(prefix="objectgs-kernels-") as folder:
        _train_a_little(Path(folder), reporter, device, steps)
    # Without a writable cache the mark is not needed.
    with contextlib.suppress(OSError):
        mark = _mark(device)
        mark.parent.mkdir(parents=True, exist_ok=True)
        mark.touch()


class _Steps(Reporter):
    """Converts the progress of a step of the compilation to that of all."""

    def __init__(self, reporter: Reporter) -> None:
        self._reporter, self._before, self._fraction = reporter, 0.0, 0.0

    def step(self, step: str) -> _Steps:
        """Begin a step and return self."""
        self._before += self._fraction
        self._fraction = _PROGRESS_FRACTIONS[step]
        self.progress(0, 1)
        return self

    def progress(self, done: float, total: float, **_: Any) -> None:
        self._reporter.progress(self._before + self._fraction * done / max(total, 1e-9), 1.0)


def _are_ready(device: torch.device) -> bool:
    """Return whether an earlier run compiled the kernels; the simulator needs no compilation."""
    return devices.simulated() or _mark(device).exists()


def _mark(device: torch.device) -> Path:
    """Return the path of the file, beside numba's cache, that marks the kernels of these sources as compiled.

    Its name depends on the sources, their folder (as numba's cache does), numba's version and the device.
    """
    sources = Path(__file__).resolve().parents[2]
    processor = f"{llvmlite.binding.get_host_cpu_name()} {devices.name_of(device)}"
    kernels = f"{sources} {digest_up_to('pointing')} {numba.__version__} {processor}"
    folder = Path(numba.config.CACHE_DIR or sources / "raster" / "__pycache__")
    return folder / f"objectgs-{hashlib.sha256(kernels.encode()).hexdigest()[:16]}.ready"


def _train_a_little(scratch: Path, reporter: StoppingReporter, device: torch.device, steps: _Steps) -> None:
    """Train on a synthetic capture, draw, mesh and label it, so that each kernel is compiled, cached and run."""
    capture_folder, folder = scratch / "capture", Reconstruction(scratch / "out").create()
    _write_small_capture(capture_folder)
    quiet = Reporter()
    capture = load_capture(capture_folder, folder.cache, reporter=quiet)
    ids = vote_points(capture, reporter=quiet).ids
    steps.step("step")
    discs = Trainer.start(capture, ids, Settings(offsets=2, primitive="2d"), device=device)
    for progress in (0.0, 1.0):
        discs.step(progress)
    trainer = Trainer.start(capture, ids, Settings(offsets=2), device=device)
    trainer.run(Budget(steps=STEPS), folder.checkpoint, steps.step("train"), stop=reporter.stop)
    _mesh_a_little(trainer, steps)
    find_depth_maps(capture, range(len(capture.views)), steps.step("match").progress)
    random_walker(sparse.csr_array(np.eye(2)[::-1]), np.array([0, -1]), np.zeros((2, 2)), 0.0)
    rendering = draw(trainer.model, trainer.scene.camera(0), want_depth=True)
    if not np.isfinite(rendering.image).all():
        raise RuntimeError("a short training rendered an image that is not finite")


def _mesh_a_little(trainer: Trainer, steps: _Steps) -> None:
    """Extract a mesh of the first object, if it has a surface, and bake the texture of a tetrahedron."""
    views = Views(trainer.model, trainer.scene, trainer.scene.capture.train_indices)
    with contextlib.suppress(NoSurface):
        extract(fuse(views, [1], reporter=steps.step("fuse")), faces=500)
    # Large, within the mask of the object and with a corner toward the cameras, so that photos show it well.
    corners = np.array([[0.6, 0, 0], [-0.6, 0.6, 0], [-0.6, -0.6, 0], [0, 0, -0.4]]) - [0.8, 0, 0]
    faces = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]], np.int32)
    shape = refine(Surface(corners, faces, np.zeros(4, bool)), views, [1], steps.step("refine"))
    bake_texture(shape, unwrap(shape, 64), 64, views, [1], reporter=steps.step("bake"))


def _write_small_capture(folder: Path) -> None:
    """Write a capture of two clusters of points: four views, 64x48, with masks, and a COLMAP model as text."""
    rng = np.random.default_rng(0)
    for name in ("images", "masks", "sparse/0"):
        (folder / name).mkdir(parents=True)
    points = rng.normal(0, 0.3, (200, 3)) + np.where(np.arange(200) < 100, -0.5, 0.5)[:, None] * [1, 0, 0]
    images = []
    for i in range(4):
        images += [f"{i + 1} 1 0 0 0 {0.2 * i - 0.3} 0 3 1 {i}.png", ""]
        Image.fromarray(rng.integers(0, 255, (48, 64, 3), np.uint8)).save(folder / "images" / f"{i}.png")
        Image.fromarray(np.repeat([[1] * 32 + [2] * 32], 48, 0).astype(np.uint8)).save(folder / "masks" / f"{i}.png")
    model = {
        "cameras": ["1 PINHOLE 64 48 64 64 32 24"],
        "images": images,
        "points3D": [f"{i} {x} {y} {z} 128 128 128 0" for i, (x, y, z) in enumerate(points.tolist())],
    }
    for name, lines in model.items():
        (folder / "sparse/0" / f"{name}.txt").write_text("\n".join(lines) + "\n")
