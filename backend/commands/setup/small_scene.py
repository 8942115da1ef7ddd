"""A training of a few splats and all that follows it, which compiles each kernel, caches and runs it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

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
from ...mesh.texture.completion import complete
from ...mesh.texture.unwrap import unwrap
from ...mesh.views import Views
from ...model.draw import draw
from ...pointing.clusters import nested_clusters
from ...pointing.random_walker import connected_with, random_walker
from ...raster.ranked_ids import add_ranked
from ...shared.events import Reporter
from ...shared.reconstruction.folder import Reconstruction
from ...shared.stopping import StopRequest
from ...stereo.depth_maps import find_depth_maps
from ...training.budget import Budget
from ...training.settings import Settings
from ...training.trainer import Trainer

STEPS = 220
"""Takes a second or two, and includes growth, which occurs every 50 steps in the first half of the training."""


class SmallScene:
    """A capture of two clusters of points, and the kinds of work that have kernels of their own.

    Args:
        scratch: A folder for it, which is empty or does not exist.
        device: The device to train on.
    """

    def __init__(self, scratch: Path, device: torch.device) -> None:
        self.device = device
        self._folder = Reconstruction(scratch / "out").create()
        _write_capture(scratch / "capture")
        quiet = Reporter()
        self._capture = load_capture(scratch / "capture", self._folder.cache, reporter=quiet)
        self._ids = vote_points(self._capture, reporter=quiet).ids

    def start(self, primitive: str = "3d") -> Trainer:
        """Return a training of 3D Gaussians or of discs, "2d", at its start."""
        return Trainer.start(self._capture, self._ids, Settings(offsets=2, primitive=primitive), device=self.device)

    def train(self, reporter: Reporter, stop: StopRequest) -> Trainer:
        """Train 3D Gaussians, draw them, and return the training.

        Raises:
            RuntimeError: The image is not finite.
        """
        trainer = self.start()
        trainer.run(Budget(steps=STEPS), self._folder.checkpoint, reporter, stop=stop)
        rendering = draw(trainer.model, trainer.scene.camera(0), want_depth=True)
        if not np.isfinite(rendering.image).all():
            raise RuntimeError("a short training rendered an image that is not finite")
        # As the frames of films.
        one = np.ones((1, 1, 1), np.float32)
        add_ranked(-one.astype(np.int32), 0 * one, one.astype(np.int32), one)
        return trainer

    def train_discs(self) -> None:
        """Take a first and a last step with discs."""
        discs = self.start("2d")
        for progress in (0.0, 1.0):
            discs.step(progress)

    def match(self, progress: Callable[[int, int], None] = lambda _done, _total: None) -> None:
        """Find depths in the photos, and label a graph."""
        find_depth_maps(self._capture, range(len(self._capture.views)), progress)
        graph = sparse.csr_array(np.eye(2)[::-1])
        _, clusters = nested_clusters(graph)
        random_walker(graph, np.array([0, -1]), np.zeros((2, 2)), 0.0, clusters=clusters)
        connected_with(graph, np.array([0, 0]), np.array([True, False]))

    def mesh(self, trainer: Trainer, reporter: Callable[[str], Reporter] = lambda _step: Reporter()) -> None:
        """Extract a mesh of the first object, if it has a surface, and bake the texture of a tetrahedron.

        Args:
            trainer: A training of Gaussians.
            reporter: Returns what receives the progress of a step: "fuse", "refine" or "bake".
        """
        views = Views(trainer.model, trainer.scene, trainer.scene.capture.train_indices)
        with contextlib.suppress(NoSurface):
            extract(fuse(views, [1], reporter=reporter("fuse")), faces=500)
        # Large, within the mask of the object and with a corner toward the cameras, so that photos show it well.
        corners = np.array([[0.6, 0, 0], [-0.6, 0.6, 0], [-0.6, -0.6, 0], [0, 0, -0.4]]) - [0.8, 0, 0]
        faces = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]], np.int32)
        shape = refine(Surface(corners, faces, np.zeros(4, bool)), views, [1], reporter("refine"))
        bake_texture(shape, unwrap(shape, 64), 64, views, [1], reporter=reporter("bake"))
        hidden = np.zeros((24, 24), bool)
        hidden[10:12, 10:12] = True
        complete(np.zeros((24, 24, 3)), ~hidden, hidden)


def _write_capture(folder: Path) -> None:
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
