"""Splats that objects can be pointed at: those of a trained model, or those of another program."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ...capture import Capture, load_capture
from ...export import read_splats
from ...model.generate import Generated
from ...model.object_model import Normalization
from ...model.splats import Splats
from ...pointing.pointer import Pointer
from ...pointing.stroke_masks import Segment
from ...pointing.views import Views, views_around, views_of_photos
from ...raster import Camera, devices
from ...segmentation import KeptEncodings, Segmenter
from ...shared.defaults import MAX_SIZE
from ...shared.errors import InputError
from ...shared.events import Reporter
from ...shared.reconstruction.folder import Reconstruction
from ...shared.reconstruction.record import read_record
from ..cameras import read_upright
from ..folder import READ, Trained, memory_for_files, open_trained

GRAPH = "graph"
"""Name of the preparation among the parts of a command."""


class Pointable(NamedTuple):
    """Opened splats.

    Attributes:
        folder: the reconstruction.
        source: what they are: a trained model, or the content of splats.ply.
        splats: the splats, in scene units.
        in_file: (N,) bool, which of them are in splats.ply; those that cannot be drawn are not.
        primitive: "3d" or "2d".
        views: views of them.
    """

    folder: Reconstruction
    source: Trained | Splats
    splats: Generated
    in_file: np.ndarray
    primitive: str
    views: Views

    @property
    def device(self) -> torch.device:
        """The device of the splats."""
        return self.splats.means.device

    def pointer(self, progress: Callable[[int, int], object], segment: Segment | None = None) -> Pointer:
        """Compare the splats with their neighbors; the arguments are those of `Pointer`."""
        return Pointer(self.splats, self.primitive, self.views, progress, segment)


def open_pointable(options: argparse.Namespace, reporter: Reporter) -> Pointable:
    """Open the splats of a reconstruction.

    Args:
        options: Options with the folder, and the device to load the splats on; `capture` replaces a recorded folder.
        reporter: Receives status and warnings.

    Raises:
        InputError: They are missing, cannot be read or depend on the view, or the capture of a training is missing.
    """
    folder = Reconstruction(options.folder)
    if folder.splats.exists() and not folder.checkpoint.exists():
        return _without_training(folder, options, reporter)
    return pointable_of(open_trained(options, reporter))


def pointable_of(trained: Trained) -> Pointable:
    """Return the splats of a trained model; raises InputError if they depend on the view."""
    model, scene = trained.model, trained.scene
    if not model.explicit:
        raise InputError(
            f"{trained.folder.folder} has a view-dependent model; train it with --mode explicit to label it."
        )
    splats = model.generate()
    in_file = np.isin(devices.host(splats.source), model.splats()[1])
    views = views_of_photos(trained.capture, scene.camera, scene.normalization)
    return Pointable(trained.folder, trained, splats, in_file, model.primitive, views)


def segmentation(options: argparse.Namespace, device: torch.device) -> KeptEncodings | None:
    """Return the model of --segmenter, if it is given; raises InputError if its folder has none."""
    return None if options.segmenter is None else KeptEncodings(Segmenter(options.segmenter, device=device))


def _without_training(folder: Reconstruction, options: argparse.Namespace, reporter: Reporter) -> Pointable:
    """Open splats of another program, with the photos of their capture if it is known and exists."""
    reporter.begin(READ, "Reading the splats")
    splats, warnings = read_splats(folder.splats)
    for sentence in warnings:
        reporter.warning(sentence)
    if not len(splats):
        raise InputError(f"{folder.splats} contains no splats.")
    recorded = read_record(folder).capture
    source = options.capture or (None if recorded is None else Path(recorded.folder))
    normalization = Normalization.of(splats.means, splats.means)
    generated = _in_scene_units(splats, normalization, devices.pick(options.device))
    if source is not None and source.is_dir():
        max_size = MAX_SIZE if recorded is None else recorded.max_size
        capture = load_capture(source, folder.cache, memory_for_files(options), max_size, reporter)
        views = views_of_photos(capture, lambda index: _camera(capture, index, normalization), normalization)
    else:
        views = views_around(normalization.to_scene(splats.means), read_upright(folder).rotation[2], normalization)
    return Pointable(folder, splats, generated, np.ones(len(splats), bool), "3d", views)


def _in_scene_units(splats: Splats, normalization: Normalization, device: torch.device) -> Generated:
    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.tensor(values, dtype=torch.float32, device=device)

    return Generated(
        tensor(normalization.to_scene(splats.means)), tensor(splats.quats), tensor(splats.scales * normalization.scale),
        tensor(splats.opacities), tensor(splats.sh), torch.zeros(len(splats), dtype=torch.int32, device=device),
        torch.arange(len(splats), device=device),
    )  # fmt: skip


def _camera(capture: Capture, index: int, normalization: Normalization) -> Camera:
    view = capture.views[index]
    return Camera(normalization.viewmat(view.viewmat), view.K, view.width, view.height)
