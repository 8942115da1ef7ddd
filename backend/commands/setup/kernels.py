"""Compilation of all kernels before a training's time is measured, once per machine."""

from __future__ import annotations

import contextlib
import hashlib
import tempfile
from pathlib import Path

import llvmlite.binding
import numba
import numpy as np
import torch
from PIL import Image

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
from ...raster import compile_kernels, devices
from ...raster.kernel import digest_up_to
from ...shared.events import Reporter
from ...shared.reconstruction.folder import Reconstruction
from ...shared.stopping import StoppingReporter
from ...training.budget import Budget
from ...training.settings import Settings
from ...training.trainer import Trainer

STEPS = 220
"""Takes a second or two, and includes growth, which occurs every 50 steps in the first half of the training."""


def ensure_kernels(reporter: StoppingReporter, device: torch.device) -> None:
    """Compile the kernels of a device, unless an earlier run did; the simulator needs no compilation.

    Args:
        reporter: Receives status and progress; may stop the compilation.
        device: The device to compile for.

    Raises:
        Cancelled: The user stopped the command.
    """
    if not devices.simulated() and not _mark(device).exists():
        try_kernels(reporter, device)


def try_kernels(reporter: StoppingReporter, device: torch.device) -> None:
    """Compile all kernels of a device and run them in a training of a few splats."""
    reporter.status("Compiling the renderer's kernels (once per machine)")
    compile_kernels(device, lambda done, total: reporter.progress(done, total))
    reporter.status("Testing them on a few splats")
    with tempfile.TemporaryDirectory(prefix="objectgs-kernels-") as folder:
        _train_a_little(Path(folder), reporter, device)
    # Without a writable cache the mark is not needed.
    with contextlib.suppress(OSError):
        mark = _mark(device)
        mark.parent.mkdir(parents=True, exist_ok=True)
        mark.touch()


def _mark(device: torch.device) -> Path:
    """Return the path of the file, beside numba's cache, that marks the kernels of these sources as compiled.

    Its name depends on the sources, their folder (as numba's cache does), numba's version and the device.
    """
    sources = Path(__file__).resolve().parents[2]
    processor = f"{llvmlite.binding.get_host_cpu_name()} {devices.name_of(device)}"
    kernels = f"{sources} {digest_up_to('mesh')} {numba.__version__} {processor}"
    folder = Path(numba.config.CACHE_DIR or sources / "raster" / "__pycache__")
    return folder / f"objectgs-{hashlib.sha256(kernels.encode()).hexdigest()[:16]}.ready"


def _train_a_little(scratch: Path, reporter: StoppingReporter, device: torch.device) -> None:
    """Train on a synthetic capture, draw and mesh it, so that each kernel is compiled, cached and run."""
    capture_folder, folder = scratch / "capture", Reconstruction(scratch / "out").create()
    _write_small_capture(capture_folder)
    quiet = Reporter()
    capture = load_capture(capture_folder, folder.cache, reporter=quiet)
    ids = vote_points(capture, reporter=quiet).ids
    discs = Trainer.start(capture, ids, Settings(offsets=2, primitive="2d"), device=device)
    for progress in (0.0, 1.0):
        discs.step(progress)
    trainer = Trainer.start(capture, ids, Settings(offsets=2), device=device)
    trainer.run(Budget(steps=STEPS), folder.checkpoint, quiet, stop=reporter.stop)
    _mesh_a_little(trainer)
    rendering = draw(trainer.model, trainer.scene.camera(0), want_depth=True)
    if not np.isfinite(rendering.image).all():
        raise RuntimeError("a short training rendered an image that is not finite")


def _mesh_a_little(trainer: Trainer) -> None:
    """Extract a mesh of the first object, if it has a surface, and bake the texture of a tetrahedron."""
    views = Views(trainer.model, trainer.scene, trainer.scene.capture.train_indices)
    with contextlib.suppress(NoSurface):
        extract(fuse(views, [1]), faces=500)
    corners = np.array([[0.3, 0, 0], [-0.3, 0.3, 0], [-0.3, -0.3, 0], [0, 0, 0.4]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)
    shape = refine(Surface(corners, faces, np.zeros(4, bool)), views, [1])
    bake_texture(shape, unwrap(shape, 64), 64, views, [1])


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
