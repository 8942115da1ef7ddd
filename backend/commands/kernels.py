"""Compiling all kernels before the clock of a training runs, once for a machine."""

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

from .. import device
from ..capture import load_capture
from ..labels import vote as vote_points
from ..mesh.extract import extract
from ..mesh.fusion import fuse
from ..mesh.refine import refine
from ..mesh.surface import NoSurface, Surface
from ..mesh.texture import dress
from ..mesh.unwrap import unwrap
from ..mesh.views import Views
from ..protocol import Reconstruction, Reporter
from ..raster import compile_kernels
from ..raster.draw import draw
from ..raster.kernel import digest_up_to
from ..stopping import StoppingReporter
from ..training.budget import Budget
from ..training.loop import Trainer
from ..training.settings import Settings

STEPS = 220
"""A second or two, and enough for anchors to grow: every 50 steps, in the first half of the training."""


def have_kernels_ready(reporter: StoppingReporter, place: torch.device) -> None:
    """Compile what a device needs and is not compiled yet on this machine; returns at once where a run before has done
    it, and in the simulator, which compiles nothing."""
    if not device.simulated() and not _mark(place).exists():
        try_kernels(reporter, place)


def try_kernels(reporter: StoppingReporter, place: torch.device) -> None:
    """Compile all kernels that a device needs, with progress, and see them run in a training of a few splats."""
    reporter.status("Compiling the renderer's kernels (once for a machine)")
    compile_kernels(place, lambda done, total: reporter.progress(done, total))
    reporter.status("Trying them on a few splats")
    with tempfile.TemporaryDirectory(prefix="objectgs-kernels-") as folder:
        _train_a_little(Path(folder), reporter, place)
    # A cache that cannot be written to has no use for the mark either.
    with contextlib.suppress(OSError):
        mark = _mark(place)
        mark.parent.mkdir(parents=True, exist_ok=True)
        mark.touch()


def _mark(place: torch.device) -> Path:
    """A file beside numba's own that says: the kernels of these sources, which numba knows by where they lie, are
    there, for this numba and these devices."""
    sources = Path(__file__).resolve().parents[1]
    processor = f"{llvmlite.binding.get_host_cpu_name()} {device.name_of(place)}"
    kernels = f"{sources} {digest_up_to('mesh')} {numba.__version__} {processor}"
    folder = Path(numba.config.CACHE_DIR or sources / "raster" / "__pycache__")
    return folder / f"objectgs-{hashlib.sha256(kernels.encode()).hexdigest()[:16]}.ready"


def _train_a_little(scratch: Path, reporter: StoppingReporter, place: torch.device) -> None:
    """Take a made-up capture through every part, so that each kernel is compiled, cached and seen to run."""
    capture_folder, folder = scratch / "capture", Reconstruction(scratch / "out").create()
    _write_small_capture(capture_folder)
    quiet = Reporter()
    capture = load_capture(capture_folder, folder.cache, reporter=quiet)
    ids = vote_points(capture, reporter=quiet).ids
    discs = Trainer.start(capture, ids, Settings(offsets=2, primitive="2d"), place=place)
    for share in (0.0, 1.0):
        discs.step(share)
    trainer = Trainer.start(capture, ids, Settings(offsets=2), place=place)
    trainer.run(Budget(steps=STEPS), folder.checkpoint, quiet, stop=reporter.stop)
    _mesh_a_little(trainer)
    picture = draw(trainer.model, trainer.scene.camera(0), want_depth=True)
    if not np.isfinite(picture.image).all():
        raise RuntimeError("a small training ended in a picture that is not finite")


def _mesh_a_little(trainer: Trainer) -> None:
    """A mesh of the first object, and looks for a tetrahedron, where that has no surface yet."""
    views = Views(trainer.model, trainer.scene, trainer.scene.capture.train_indices)
    with contextlib.suppress(NoSurface):
        extract(fuse(views, [1]), faces=500)
    corners = np.array([[0.3, 0, 0], [-0.3, 0.3, 0], [-0.3, -0.3, 0], [0, 0, 0.4]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)
    shape = refine(Surface(corners, faces, np.zeros(4, bool)), views, [1])
    dress(shape, unwrap(shape, 64), 64, views, [1])


def _write_small_capture(folder: Path) -> None:
    """Four views, 64x48, of two clusters of points, with masks; a COLMAP model in text."""
    rng = np.random.default_rng(0)
    for name in ("images", "masks", "sparse/0"):
        (folder / name).mkdir(parents=True)
    points = rng.normal(0, 0.3, (200, 3)) + np.where(np.arange(200) < 100, -0.5, 0.5)[:, None] * [1, 0, 0]
    pictures = []
    for i in range(4):
        pictures += [f"{i + 1} 1 0 0 0 {0.2 * i - 0.3} 0 3 1 {i}.png", ""]
        Image.fromarray(rng.integers(0, 255, (48, 64, 3), np.uint8)).save(folder / "images" / f"{i}.png")
        Image.fromarray(np.repeat([[1] * 32 + [2] * 32], 48, 0).astype(np.uint8)).save(folder / "masks" / f"{i}.png")
    model = {
        "cameras": ["1 PINHOLE 64 48 64 64 32 24"],
        "images": pictures,
        "points3D": [f"{i} {x} {y} {z} 128 128 128 0" for i, (x, y, z) in enumerate(points.tolist())],
    }
    for name, lines in model.items():
        (folder / "sparse/0" / f"{name}.txt").write_text("\n".join(lines) + "\n")
