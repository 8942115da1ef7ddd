"""What objects can be pointed at: the splats of a trained model or of another program, or else the capture's points."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree

from ...capture import Capture, load_capture
from ...export import ExactSplats, read_splats
from ...model.generate import Generated
from ...model.object_model import Normalization
from ...model.splats import Splats
from ...pointing.pointer import Pointer
from ...pointing.splat_graph import OF_POINTS, OF_SPLATS
from ...pointing.stroke_masks import Segment
from ...pointing.views import Views, views_around, views_of_photos
from ...raster import Camera, devices
from ...segmentation import KeptEncodings, Segmenter
from ...shared.defaults import MAX_SIZE
from ...shared.errors import InputError
from ...shared.events import Reporter
from ...shared.formats.points_ply import LabeledPoints, read_points
from ...shared.reconstruction.folder import Reconstruction
from ...shared.reconstruction.record import read_record
from ...shared.splats.spherical_harmonics import C0
from ..cameras import read_upright
from ..folder import READ, Trained, memory_for_files, open_trained
from ..setup.device import choose_device

GRAPH = "graph"
"""Name of the preparation among the parts of a command."""

_FEWEST_POINTS = 20
"""Number of points from which on objects are looked for among them."""
_BALL, _LARGEST, _OPACITY = 0.7, 3.0, 0.9
"""Deviation of the ball of a point relative to the mean distance of the three nearest others, and at most relative to
the median of these distances; and its opacity."""


class Pointable(NamedTuple):
    """Opened splats.

    Attributes:
        folder: the reconstruction.
        source: what they are: a trained model, the content of splats.ply, or that of points.ply.
        splats: the splats, in scene units; a point is a ball.
        in_file: (N,) bool, which of them are in the file that is shown; those that cannot be drawn are not.
        primitive: "3d" or "2d".
        views: views of them.
        capture: the capture, without masks that the training does not use; None if it is not known.
    """

    folder: Reconstruction
    source: Trained | Splats | LabeledPoints
    splats: Generated
    in_file: np.ndarray
    primitive: str
    views: Views
    capture: Capture | None

    @property
    def device(self) -> torch.device:
        """The device of the splats."""
        return self.splats.means.device

    def pointer(self, progress: Callable[[int, int], object], segment: Segment | None = None) -> Pointer:
        """Compare the splats with their neighbors; the arguments are those of `Pointer`."""
        weights = OF_POINTS if isinstance(self.source, LabeledPoints) else OF_SPLATS
        return Pointer(self.splats, self.primitive, self.views, weights, progress, segment)


def open_pointable(options: argparse.Namespace, reporter: Reporter) -> Pointable:
    """Open the splats of a reconstruction, or its points where there are no splats yet.

    Args:
        options: Options with the folder, and the device to load the splats on; `capture` replaces a recorded folder.
        reporter: Receives status and warnings.

    Raises:
        InputError: They are missing, cannot be read or depend on the view, or the capture of a training is missing.
    """
    folder = Reconstruction(options.folder)
    if folder.checkpoint.exists() or not (folder.splats.exists() or folder.points.exists()):
        return _of_training(open_trained(options, reporter))
    if folder.splats.exists():
        return _of_splats(folder, options, reporter)
    return _of_points(folder, options, reporter)


def require_splats(opened: Pointable) -> Trained | Splats:
    """Return what opened splats are; raises InputError if there are only points."""
    if isinstance(opened.source, LabeledPoints):
        raise InputError(f"{opened.folder.folder} has no splats yet; train first, and run this again.")
    return opened.source


def _of_training(trained: Trained) -> Pointable:
    """Return the splats of a trained model; raises InputError if they depend on the view."""
    model, scene = trained.model, trained.scene
    if not model.explicit:
        raise InputError(
            f"{trained.folder.folder} has a view-dependent model; train it with --mode explicit to label it."
        )
    splats = model.generate()
    # In the same parts as the file was written in, whose rounding may depend on them.
    written = np.concatenate([part.source for part in ExactSplats(model).parts()])
    in_file = np.isin(devices.host(splats.source), written)
    views = views_of_photos(trained.capture, scene.camera, scene.normalization)._replace(blur=model.blur)
    return Pointable(trained.folder, trained, splats, in_file, model.primitive, views, trained.capture)


def segmentation(options: argparse.Namespace, device: torch.device) -> KeptEncodings | None:
    """Return the model of --segmenter, if it is given; raises InputError if its folder has none."""
    return None if options.segmenter is None else KeptEncodings(Segmenter(options.segmenter, device=device))


def _of_splats(folder: Reconstruction, options: argparse.Namespace, reporter: Reporter) -> Pointable:
    """Open splats of another program, with the photos of their capture if it is known and exists."""
    reporter.begin(READ, "Reading the splats")
    splats, warnings = read_splats(folder.splats)
    for sentence in warnings:
        reporter.warning(sentence)
    if not len(splats):
        raise InputError(f"{folder.splats} contains no splats.")
    normalization = Normalization.of(splats.means, splats.means)
    capture = _capture_of(folder, options, reporter)
    if capture is None:
        views = views_around(normalization.to_scene(splats.means), read_upright(folder).rotation[2], normalization)
    else:
        views = _views_of(capture, normalization)
    views = views._replace(camera=_filtered(views.camera, splats.blur), blur=splats.blur)
    generated = _in_scene_units(splats, normalization, choose_device(options.device, reporter))
    return Pointable(folder, splats, generated, np.ones(len(splats), bool), "3d", views, capture)


def _of_points(folder: Reconstruction, options: argparse.Namespace, reporter: Reporter) -> Pointable:
    """Open the points of a capture, each as a ball that overlaps with the nearest others."""
    reporter.begin(READ, "Reading the points")
    points = read_points(folder.points)
    capture = _capture_of(folder, options, reporter)
    if capture is None or len(points.xyz) < _FEWEST_POINTS:
        raise InputError(f"{folder.folder} has no splats yet; train first.")
    distance, _ = cKDTree(points.xyz).query(points.xyz, k=4, workers=-1)
    spacing = distance[:, 1:].mean(1)
    radii = np.clip(_BALL * spacing, 0.0, _LARGEST * np.median(spacing))
    balls = Splats(
        means=points.xyz,
        quats=np.tile(np.array([1.0, 0, 0, 0], np.float32), (len(radii), 1)),
        scales=np.repeat(np.maximum(radii, 1e-12)[:, None], 3, 1),
        opacities=np.full(len(radii), _OPACITY),
        sh=((points.rgb / 255.0 - 0.5) / C0)[:, None].astype(np.float32),
        object_ids=points.ids,
    )
    normalization = Normalization.of(points.xyz, points.xyz)
    generated = _in_scene_units(balls, normalization, choose_device(options.device, reporter))
    views = _views_of(capture, normalization)
    return Pointable(folder, points, generated, np.ones(len(radii), bool), "3d", views, capture)


def _capture_of(folder: Reconstruction, options: argparse.Namespace, reporter: Reporter) -> Capture | None:
    """Return the capture of --capture or of the record; None if it is not known, or does not exist."""
    recorded = read_record(folder).capture
    if options.capture is None and (recorded is None or not Path(recorded.folder).is_dir()):
        return None
    source = options.capture or Path(recorded.folder if recorded else "")
    max_size = MAX_SIZE if recorded is None else recorded.max_size
    return load_capture(source, folder.cache, memory_for_files(options), max_size, reporter)


def _views_of(capture: Capture, normalization: Normalization) -> Views:
    def camera(index: int) -> Camera:
        view = capture.views[index]
        return Camera(normalization.viewmat(view.viewmat), view.K, view.width, view.height)

    return views_of_photos(capture, camera, normalization)


def _filtered(camera: Callable[[int], Camera], blur: float) -> Callable[[int], Camera]:
    """Return the same cameras with another low-pass filter."""
    return lambda index: replace(camera(index), blur=blur)


def _in_scene_units(splats: Splats, normalization: Normalization, device: torch.device) -> Generated:
    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.tensor(values, dtype=torch.float32, device=device)

    return Generated(
        tensor(normalization.to_scene(splats.means)), tensor(splats.quats), tensor(splats.scales * normalization.scale),
        tensor(splats.opacities), tensor(splats.sh), torch.zeros(len(splats), dtype=torch.int32, device=device),
        torch.arange(len(splats), device=device),
    )  # fmt: skip
