"""A view-dependent model as plain splats: what the cameras see of each splat, averaged, and its colour fitted.

In `view` mode opacity, shape and colour of a splat change with the camera, and in some views it is not there at all.
A file holds one opacity, one shape and spherical harmonics, so these are fitted over the training cameras, each view
counting as much as the splat adds to its picture. What that costs, `agreement` measures. On a capture of a table-top
the fit is 34.6 dB from the model's own held-out pictures; shapes averaged as covariances give 33.5, degree 1 gives
32.6, and the model as seen from the middle of the cameras 29.2. Degree 3 comes no closer in views that it was not
fitted to.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .. import device, spherical_harmonics
from ..evaluation.metrics import psnr
from ..model.object_model import ObjectModel, anchors_in_view
from ..model.splats import Splats, concatenate
from ..protocol import Reporter
from ..raster import Camera, rasterize
from ..raster.draw import draw
from ..raster.reference import rotation_matrices

SH_DEGREE = 2

MAX_VIEWS = 200
"""So many cameras are enough to know a splat from all its sides; of more, these are taken evenly."""

RIDGE = 0.002
"""Pull of the higher bands to zero, as a share of what a splat's views weigh: one seen from few sides stays tame."""

_ANCHORS_AT_ONCE = 50_000
_SPLATS_AT_ONCE = 50_000
_SMALLEST = 1e-9
_UPPER = np.triu_indices((SH_DEGREE + 1) ** 2)
_UPPER_3 = np.triu_indices(3)


def fit_splats(
    model: ObjectModel, cameras: Sequence[Camera], reporter: Reporter | None = None
) -> tuple[Splats, NDArray[np.int64]]:
    """The plain splats in world units that look most like `model` through `cameras` (scene units), and source (N,):
    anchor * offsets + offset of each.

    Splats that no camera sees are left out: nothing has taught them.
    """
    reporter = reporter or Reporter()
    taken = np.unique(np.linspace(0, len(cameras) - 1, min(len(cameras), MAX_VIEWS)).astype(int))
    starts = range(0, len(model.anchors), _ANCHORS_AT_ONCE)
    parts: list[Splats] = []
    sources = [np.zeros(0, np.int64)]
    for start in starts:
        sums = _Sums(model, start, min(start + _ANCHORS_AT_ONCE, len(model.anchors)))
        for done, index in enumerate(taken, 1):
            sums.add(cameras[index])
            reporter.progress(len(parts) * len(taken) + done, len(starts) * len(taken), what="views")
        parts.append(sums.splats())
        sources.append(sums.used() + start * model.anchors.layout.offsets)
    return concatenate(parts) if parts else Splats.empty(SH_DEGREE), np.concatenate(sources)


def agreement(model: ObjectModel, splats: Splats, cameras: Sequence[Camera]) -> float | None:
    """Mean PSNR in dB of `splats` against the model's own pictures through `cameras`; None without cameras."""

    def tensor(values: NDArray) -> torch.Tensor:
        return device.upload(np.ascontiguousarray(values, np.float32), model.device)

    means = tensor(model.normalization.to_scene(splats.means))
    scales = tensor(splats.scales * model.normalization.scale)
    quats, opacities, sh = tensor(splats.quats), tensor(splats.opacities), tensor(splats.sh)
    ids = torch.zeros(len(splats), dtype=torch.int32, device=model.device)
    found = []
    for camera in cameras:
        with torch.no_grad():
            drawn = rasterize(means, quats, scales, opacities, sh, ids, camera)
            image = drawn.color + (1 - drawn.alpha) * model.background.detach()[:, None, None]
            image = image * torch.tensor(camera.gain).to(image.device)[:, None, None]
        shown = device.host(image.clamp(0, 1).permute(1, 2, 0))
        found.append(psnr(shown, draw(model, camera, want_ids=False).image))
    return float(np.mean(found)) if found else None


class _Sums:
    """What the views add up to for each offset of the anchors start .. stop - 1, n in all.

    weight (n,): how many pixels the splat fills, over all views. With these weights: opacity (n,), shape (n, 6) the
    upper part of the covariances' logarithm (their mean keeps a thin splat thin), and the least squares of the colour,
    normal (n, 45) the upper part of its matrix and colour (n, 9, 3) its right side. means (n, 3) hold in every view.
    """

    def __init__(self, model: ObjectModel, start: int, stop: int) -> None:
        self.model = model
        self.k = model.anchors.layout.offsets
        self.first = start * self.k
        n = (stop - start) * self.k
        self.weight = np.zeros(n, np.float32)
        self.opacity = np.zeros(n, np.float32)
        self.means = np.zeros((n, 3), np.float32)
        self.shape = np.zeros((n, len(_UPPER_3[0])), np.float32)
        self.normal = np.zeros((n, len(_UPPER[0])), np.float32)
        self.colour = np.zeros((n, (SH_DEGREE + 1) ** 2, 3), np.float32)

    def add(self, camera: Camera) -> None:
        """Count what one camera sees."""
        model = self.model
        viewmat, intrinsics = camera.arrays()
        seen = anchors_in_view(model.anchors, viewmat, intrinsics, camera.width, camera.height, camera.near)
        g = model.generate(seen, camera.centre)
        # With black splats, the gradient of the picture's sum by their colours is how many pixels each of them fills.
        black = torch.zeros_like(g.sh).requires_grad_()
        drawn = rasterize(g.means, g.quats, g.scales, g.opacities, black, g.ids, camera, primitive=model.primitive)
        drawn.color[0].sum().backward()
        assert black.grad is not None
        weight = device.host(black.grad[:, 0, 0]) / np.float32(spherical_harmonics.C0)
        g = g.cpu()
        source = g.source.numpy()
        slots = device.host(seen)[source // self.k] * self.k + source % self.k - self.first
        mine = (weight > 0) & (slots >= 0) & (slots < len(self.weight))
        slots, w = slots[mine], weight[mine]
        means = g.means.numpy()[mine]
        directions = means - camera.centre
        directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
        basis = spherical_harmonics.basis(directions.astype(np.float32), SH_DEGREE)
        colour = np.maximum(g.sh.numpy()[mine, 0] * spherical_harmonics.C0, -0.5)

        self.means[slots] = means
        self.weight[slots] += w
        self.opacity[slots] += w * g.opacities.numpy()[mine]
        self.shape[slots] += w[:, None] * _log_covariances(g.quats[mine], g.scales[mine])
        self.normal[slots] += w[:, None] * basis[:, _UPPER[0]] * basis[:, _UPPER[1]]
        self.colour[slots] += (w[:, None] * basis)[:, :, None] * colour[:, None, :]

    def used(self) -> NDArray[np.int64]:
        """The slots, from this part's first on, of splats that some camera sees: (n,), ascending."""
        return np.flatnonzero(self.weight > 0)

    def splats(self) -> Splats:
        """The fitted splats, in world units, in the order of `used`."""
        used = self.used()
        pieces = np.split(used, range(_SPLATS_AT_ONCE, len(used), _SPLATS_AT_ONCE))
        return concatenate([self._fitted(piece) for piece in pieces])

    def _fitted(self, slots: NDArray) -> Splats:
        model, weight = self.model, self.weight[slots].astype(np.float64)[:, None]
        quats, scales = _axes(self.shape[slots] / weight)
        size = (SH_DEGREE + 1) ** 2
        normal = np.zeros((len(slots), size, size))
        normal[:, _UPPER[0], _UPPER[1]] = normal[:, _UPPER[1], _UPPER[0]] = self.normal[slots] / weight
        pull = np.full(size, RIDGE)
        pull[0] = 1e-6
        sh = np.linalg.solve(normal + np.diag(pull), self.colour[slots] / weight[:, :, None])
        owners = device.host(model.anchors.ids)[(slots + self.first) // self.k]
        return Splats(
            means=model.normalization.to_world(self.means[slots]),
            quats=quats.astype(np.float32),
            scales=scales / model.normalization.scale,
            opacities=(self.opacity[slots] / weight[:, 0]).astype(np.float32),
            sh=sh.astype(np.float32),
            object_ids=model.object_ids[owners],
        )


def _log_covariances(quats: torch.Tensor, scales: torch.Tensor) -> NDArray[np.float32]:
    """The upper part of the logarithm of each covariance: quats (n, 4) of any length, scales (n, 3) -> (n, 6)."""
    axes = rotation_matrices(torch.nn.functional.normalize(quats))
    logs = 2 * torch.log(scales.clamp(min=_SMALLEST))
    return ((axes * logs[:, None, :]) @ axes.transpose(1, 2)).numpy()[:, _UPPER_3[0], _UPPER_3[1]]


def _axes(shape: NDArray) -> tuple[NDArray, NDArray]:
    """Unit quaternions (n, 4) wxyz and scales (n, 3) of covariances; `shape` (n, 6): their logarithms' upper parts."""
    logs = np.zeros((len(shape), 3, 3))
    logs[:, _UPPER_3[0], _UPPER_3[1]] = logs[:, _UPPER_3[1], _UPPER_3[0]] = shape
    values, axes = np.linalg.eigh(logs)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    quats = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]] if len(axes) else np.zeros((0, 4))
    return quats, np.exp(values / 2)
