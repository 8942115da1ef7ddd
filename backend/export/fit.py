"""Fitting of plain splats to a view-dependent model.

In `view` mode, opacity, shape and color of a splat depend on the camera, and in some views it does not exist. A file
stores one opacity, one shape and spherical harmonics for each splat, so these are fitted over the training cameras,
weighted by the splat's contribution to each image. `agreement` measures the loss of quality. On a table-top capture,
the PSNR of the fit against the model's renders of held-out views is 34.6 dB. It is 33.5 dB if covariances are averaged
directly, 32.6 dB with degree 1, and 29.2 dB for splats generated from the center of the cameras. Degree 3 is no better.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..evaluation.metrics import psnr
from ..model.draw import draw
from ..model.object_model import ObjectModel, anchors_in_view
from ..model.splats import Splats, gathered
from ..raster import Camera, devices, rasterize
from ..raster.reference import rotation_matrices
from ..shared.events import Reporter
from ..shared.splats import spherical_harmonics
from .model_splats import ModelSplats

SH_DEGREE = 2

MAX_VIEWS = 200
"""Largest number of cameras, chosen evenly; enough to cover all viewing directions."""

RIDGE = 0.002
"""Regularization of the higher bands for splats with few views, as a fraction of the total weight of the views."""

_ANCHORS_AT_ONCE = 150_000
"""Number of anchors for which every view is rendered; the sums of an offset take about 330 bytes."""
_SPLATS_AT_ONCE = 50_000
_SMALLEST = 1e-9
_UPPER = np.triu_indices((SH_DEGREE + 1) ** 2)
_UPPER_3 = np.triu_indices(3)


def fit_splats(
    model: ObjectModel, cameras: Sequence[Camera], reporter: Reporter | None = None
) -> tuple[Splats, NDArray[np.int64]]:
    """Fit plain splats to a view-dependent model.

    Args:
        model: The model.
        cameras: The training cameras in scene units.
        reporter: Receives the progress.

    Returns:
        The N splats in world units, and (N,) int64 the offset that each was generated from: anchor * offsets + offset.
        Splats that are in view of no camera are left out, since they were not trained.
    """
    reporter = reporter or Reporter()
    taken = np.unique(np.linspace(0, len(cameras) - 1, min(len(cameras), MAX_VIEWS)).astype(int))
    count, k = len(model.anchors), model.anchors.layout.offsets
    starts = range(0, count, _ANCHORS_AT_ONCE)
    sources: list[NDArray[np.int64]] = []

    def fit_part(start: int) -> Iterator[Splats]:
        sums = _Sums(model, start, min(start + _ANCHORS_AT_ONCE, count))
        for done, index in enumerate(taken, 1):
            sums.add(cameras[index])
            reporter.progress(len(sources) * len(taken) + done, len(starts) * len(taken), what="views")
        sources.append(sums.used() + start * k)
        yield from sums.splats()

    if not count:
        return Splats.empty(SH_DEGREE), np.zeros(0, np.int64)
    return gathered(itertools.chain.from_iterable(map(fit_part, starts)), count * k), np.concatenate(sources)


class Agreement(NamedTuple):
    """Mean PSNR in dB of renders of plain splats to those of a model: on the model's background, and on black."""

    psnr: float
    on_black: float


def agreement(model: ObjectModel, splats: ModelSplats, cameras: Sequence[Camera]) -> Agreement | None:
    """Measure how well plain splats reproduce a model, whose renders have its background.

    Args:
        model: The model.
        splats: The exported splats.
        cameras: The cameras in scene units.

    Returns:
        The agreement; None if there are no cameras.
    """
    found = [_agreement(model, splats, camera) for camera in cameras]
    return Agreement(*np.mean(found, axis=0).tolist()) if found else None


def _agreement(model: ObjectModel, splats: ModelSplats, camera: Camera) -> list[float]:
    """Return the figures of one view, for which only splats of anchors in view are converted."""

    def tensor(values: NDArray) -> torch.Tensor:
        return devices.upload(np.ascontiguousarray(values, np.float32), model.device)

    wanted = draw(model, camera, want_ids=False).image
    near = splats.of(_anchors_in_view(model, camera)).splats
    means = tensor(model.normalization.to_scene(near.means))
    scales = tensor(near.scales * model.normalization.scale)
    quats, opacities, sh = tensor(near.quats), tensor(near.opacities), tensor(near.sh)
    ids = torch.zeros(len(near), dtype=torch.int32, device=model.device)
    with torch.no_grad():
        drawn = rasterize(means, quats, scales, opacities, sh, ids, camera)
    gain = torch.tensor(camera.gain).to(drawn.color.device)[:, None, None]
    background = model.background.detach()
    found = []
    for behind in (background, torch.zeros_like(background)):
        image = (drawn.color + (1 - drawn.alpha) * behind[:, None, None]) * gain
        found.append(psnr(devices.host(image.clamp(0, 1).permute(1, 2, 0)), wanted))
    return found


def _anchors_in_view(model: ObjectModel, camera: Camera) -> torch.Tensor:
    return anchors_in_view(model.anchors, *camera.arrays(), camera.width, camera.height, camera.near)


class _Sums:
    """Sums over the views for each of the n offsets of the anchors start .. stop - 1.

    weight (n,) is the number of pixels that the splat covers in all views. The other sums are weighted with it: opacity
    (n,); shape (n, 6), the upper triangle of the covariance's logarithm, whose mean keeps thin splats thin; normal (n,
    45) and color (n, 9, 3), the upper triangle of the matrix and the right side of the normal equations of the color.
    means (n, 3) are the same in all views.
    """

    def __init__(self, model: ObjectModel, start: int, stop: int) -> None:
        self.model = model
        self.k = model.anchors.layout.offsets
        self.start, self.stop = start, stop
        self.first = start * self.k
        n = (stop - start) * self.k
        self.weight = np.zeros(n, np.float32)
        self.opacity = np.zeros(n, np.float32)
        self.means = np.zeros((n, 3), np.float32)
        self.shape = np.zeros((n, len(_UPPER_3[0])), np.float32)
        self.normal = np.zeros((n, len(_UPPER[0])), np.float32)
        self.color = np.zeros((n, (SH_DEGREE + 1) ** 2, 3), np.float32)

    def add(self, camera: Camera) -> None:
        """Add the view of one camera."""
        model = self.model
        seen = _anchors_in_view(model, camera)
        if not ((seen >= self.start) & (seen < self.stop)).any():
            return
        g = model.generate(seen, camera.center)
        # The gradient of the image's sum with respect to a splat's color is the number of pixels it covers.
        black = torch.zeros_like(g.sh).requires_grad_()
        drawn = rasterize(g.means, g.quats, g.scales, g.opacities, black, g.ids, camera, primitive=model.primitive)
        drawn.color[0].sum().backward()
        assert black.grad is not None
        weight = devices.host(black.grad[:, 0, 0]) / np.float32(spherical_harmonics.C0)
        g = g.cpu()
        source = g.source.numpy()
        slots = devices.host(seen)[source // self.k] * self.k + source % self.k - self.first
        mine = (weight > 0) & (slots >= 0) & (slots < len(self.weight))
        slots, w = slots[mine], weight[mine]
        means = g.means.numpy()[mine]
        directions = means - camera.center
        directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
        basis = spherical_harmonics.basis(directions.astype(np.float32), SH_DEGREE)
        color = np.maximum(g.sh.numpy()[mine, 0] * spherical_harmonics.C0, -0.5)

        self.means[slots] = means
        self.weight[slots] += w
        self.opacity[slots] += w * g.opacities.numpy()[mine]
        self.shape[slots] += w[:, None] * _log_covariances(g.quats[mine], g.scales[mine])
        self.normal[slots] += w[:, None] * basis[:, _UPPER[0]] * basis[:, _UPPER[1]]
        self.color[slots] += (w[:, None] * basis)[:, :, None] * color[:, None, :]

    def used(self) -> NDArray[np.int64]:
        """Return the offsets whose splats are visible in a view, relative to the first offset: (n,), ascending."""
        return np.flatnonzero(self.weight > 0)

    def splats(self) -> Iterator[Splats]:
        """Yield the fitted splats in world units, in the order of `used`, in one part or more."""
        used = self.used()
        for piece in np.split(used, range(_SPLATS_AT_ONCE, len(used), _SPLATS_AT_ONCE)):
            yield self._fitted(piece)

    def _fitted(self, slots: NDArray) -> Splats:
        model, weight = self.model, self.weight[slots].astype(np.float64)[:, None]
        quats, scales = _axes(self.shape[slots] / weight)
        size = (SH_DEGREE + 1) ** 2
        normal = np.zeros((len(slots), size, size))
        normal[:, _UPPER[0], _UPPER[1]] = normal[:, _UPPER[1], _UPPER[0]] = self.normal[slots] / weight
        pull = np.full(size, RIDGE)
        pull[0] = 1e-6
        sh = np.linalg.solve(normal + np.diag(pull), self.color[slots] / weight[:, :, None])
        owners = devices.host(model.anchors.ids)[(slots + self.first) // self.k]
        return Splats(
            means=model.normalization.to_world(self.means[slots]),
            quats=quats.astype(np.float32),
            scales=scales / model.normalization.scale,
            opacities=(self.opacity[slots] / weight[:, 0]).astype(np.float32),
            sh=sh.astype(np.float32),
            object_ids=model.classes.ids_of(owners),
            blur=model.blur,
        )


def _log_covariances(quats: torch.Tensor, scales: torch.Tensor) -> NDArray[np.float32]:
    """Return the upper triangle (n, 6) of each covariance's logarithm; quats (n, 4) of any length, scales (n, 3)."""
    axes = rotation_matrices(torch.nn.functional.normalize(quats))
    logs = 2 * torch.log(scales.clamp(min=_SMALLEST))
    return ((axes * logs[:, None, :]) @ axes.transpose(1, 2)).numpy()[:, _UPPER_3[0], _UPPER_3[1]]


def _axes(shape: NDArray) -> tuple[NDArray, NDArray]:
    """Return unit quaternions (n, 4) wxyz and scales (n, 3); shape (n, 6): see `_log_covariances`."""
    logs = np.zeros((len(shape), 3, 3))
    logs[:, _UPPER_3[0], _UPPER_3[1]] = logs[:, _UPPER_3[1], _UPPER_3[0]] = shape
    values, axes = np.linalg.eigh(logs)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    quats = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]] if len(axes) else np.zeros((0, 4))
    return quats, np.exp(values / 2)
