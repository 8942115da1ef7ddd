"""Objects of a trained model from strokes, which may be added one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np
import torch

from ..evaluation.images import as_bytes
from ..raster import Camera, devices, object_ranks, rasterize
from ..shared.errors import InputError
from .mask_edges import follow_edges
from .splat_graph import Solution, SplatGraph, build_graph, contributions
from .strokes import Stroke, Strokes

if TYPE_CHECKING:
    from ..model.object_model import ObjectModel
    from ..training.scene import Scene

LONGEST = 640
"""Longer side in pixels of the images from viewpoints that are not those of photos."""

_RANKS = 4
"""Number of objects of a pixel that its mask is decided between."""


class StrokeOnNothing(InputError):
    """A stroke shows no splats; number: its number, from 1."""

    def __init__(self, number: int, where: str) -> None:
        super().__init__(
            f"Stroke {number} shows no splats, since nothing was reconstructed there in {where}; draw it elsewhere on "
            "the object."
        )
        self.number = number


class Pointer:
    """Finds the objects of a model's splats.

    Args:
        model: an explicit model.
        scene: its capture; masks are not used.
        progress: receives the number of prepared photos, and of all.
    """

    def __init__(self, model: ObjectModel, scene: Scene, progress: Callable[[int, int], object]) -> None:
        self.splats = model.generate()
        self._primitive, self._scene = model.primitive, scene
        self._index_of = {view.name: index for index, view in enumerate(scene.capture.views)}
        indices = list(scene.capture.train_indices)
        self._graph: SplatGraph = build_graph(
            self.splats, model.primitive, [scene.camera(index) for index in indices],
            lambda number: as_bytes(scene.capture.image(indices[number])), progress,
        )  # fmt: skip
        self._shown: dict[Stroke, np.ndarray] = {}
        self._latest: Solution | None = None

    def solve(self, strokes: Strokes) -> np.ndarray:
        """Find the object of each splat.

        Returns:
            (N,) int64 object IDs, 0 for none.

        Raises:
            StrokeOnNothing: a stroke shows no splats.
        """
        self._shown = {stroke: self._contributions(n, stroke) for n, stroke in enumerate(strokes.strokes, 1)}
        seeds: dict[int, np.ndarray] = {}
        for stroke, shown in self._shown.items():
            # So that each stroke counts as much, however long it is.
            seeds[stroke.object] = seeds.get(stroke.object, 0.0) + shown / shown.sum()
        self._latest = self._graph.solve(seeds, strokes.everything, self._latest)
        return self._latest.ids

    def masks(self, ids: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Yield each training view and its mask (H, W) int64, for the objects (N,) of the splats."""
        objects, classes = np.unique(ids, return_inverse=True)
        labeled = self.splats._replace(ids=torch.from_numpy(classes.astype(np.int32)).to(self.splats.means.device))
        for index in self._scene.capture.train_indices:
            camera = self._scene.camera(index)
            with torch.no_grad():
                drawn = rasterize(*labeled[:6], camera, primitive=self._primitive)
            shown = np.zeros((camera.height, camera.width, len(objects)), np.float32)
            for found, part in zip(*(devices.host(plane) for plane in object_ranks(drawn, _RANKS)), strict=True):
                row, column = np.nonzero(found >= 0)
                shown[row, column, found[row, column]] += part[row, column]
            if objects[0] == 0:
                shown[..., 0] += 1.0 - shown.sum(2)
            yield index, objects[follow_edges(as_bytes(self._scene.capture.image(index)), shown)]

    def _contributions(self, number: int, stroke: Stroke) -> np.ndarray:
        """Return the (N,) contributions of the splats to a stroke; number: its number, for errors."""
        if stroke in self._shown:
            return self._shown[stroke]
        camera = self._camera(stroke)
        pixels = stroke.pixels(camera.width, camera.height)
        found = contributions(self.splats, camera, np.stack([pixels] * 3), self._primitive)[:, 0]
        if not found.sum() > 0.5:
            raise StrokeOnNothing(number, stroke.view if isinstance(stroke.view, str) else "the viewport")
        return found

    def _camera(self, stroke: Stroke) -> Camera:
        """Return the camera that a stroke was drawn through, in scene units."""
        if isinstance(stroke.view, str):
            return self._scene.camera(self._index_of[stroke.view])
        view = stroke.view
        factor = min(1.0, LONGEST / max(view.width, view.height))
        fx, fy, cx, cy = (factor * value for value in view.intrinsics)
        return Camera(
            self._scene.normalization.viewmat(np.array(view.viewmat)),
            np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]),
            max(round(factor * view.width), 1), max(round(factor * view.height), 1),
        )  # fmt: skip
