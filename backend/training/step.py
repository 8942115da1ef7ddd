"""The training step of one view: rendering, loss, and gradients of the visible anchors.

On a GPU, the step is asynchronous. If the GPU's memory is too small for an image, the image is rendered in strips,
whose gradients are summed.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch

from ..gpu.kernel import kernel
from ..model.anchors import Anchors
from ..model.generate import Generated, generate
from ..model.object_model import ObjectModel, anchors_in_view, first_anchors_in_view
from ..raster import Camera, Rendered, devices, rasterize
from ..shared.errors import InputError
from . import check_finite
from .check_finite import FiniteCheck
from .exposure.photo_colors import PhotoColors, corrected
from .growth_strategy import GrowthStrategy, ViewStatistics
from .losses.on_cpu import image_loss, normal_loss, volume_loss
from .losses.silhouettes import silhouette_loss
from .optimizer.adam import take_rows
from .optimizer.head_adam import HeadAdam
from .overfitting import Dropout
from .scene import Scene
from .settings import SURFACE_FROM, Settings, downscale_at

ALONE_EVERY = 4
"""Number of steps of which one also renders the objects alone, where masks show the background."""

_ALONE = 0.1
"""Weight of the loss of objects alone, relative to that of the label loss."""

MOST_PARTS = 16
"""Largest number of parts in which an image is rendered if it does not fit into the GPU's memory."""

IN_PARTS = (
    "The GPU's memory is full, so each image is rendered in {parts} parts from here on, and fewer images are kept "
    "there; a smaller --max-size or --max-anchors would be faster."
)
"""Warning when the parts become smaller."""

_NO_ROOM = (
    "The GPU's memory is too small, even for a sixteenth of an image at a time; close programs that use it, or try a "
    "smaller --max-size or --max-anchors, or --device cpu."
)

_IMAGE = "the image loss"


class _Part(NamedTuple):
    """An image, or a strip of it.

    Attributes: camera, target (3, h, w), labels (h, w), the strip's fraction of the image's pixels, and the fraction of
    its pixels that are labeled, relative to that fraction in the whole image.
    """

    camera: Camera
    image: torch.Tensor
    labels: torch.Tensor | None
    fraction: float
    more_labels: float | torch.Tensor


class ViewGradients(NamedTuple):
    """Loss and gradients of one view.

    Attributes:
        size: width and height of the image in pixels.
        loss: () loss; NaN if it is not finite or no anchor is in view.
        seen: (n,) int64, the anchors in view.
        rows: (n, columns), gradients of their rows.
        heads: gradients of the parameters of the heads and of the background, in the order of `HeadAdam`; None for
            those that the loss does not depend on.
        colors: (2, 3), gradient of the photo's correction, if it is fitted.
        in_view: () int64, on the GPU, if it renders the whole image: number of anchors in view.
        finite: () bool, on the GPU: whether the loss is finite and any anchor is in view.
        usable: (n,) bool, on the GPU: the rows whose gradients may be used.
        statistics: statistics of the image, if growth requires them.
    """

    size: tuple[int, int]
    loss: torch.Tensor
    seen: torch.Tensor
    rows: torch.Tensor
    heads: Sequence[torch.Tensor | None]
    colors: torch.Tensor | None
    in_view: torch.Tensor | None
    finite: torch.Tensor | None
    usable: torch.Tensor | None
    statistics: ViewStatistics | None


class _Limits:
    """Upper limits of the number of anchors in each view, to avoid synchronization with the GPU.

    The limit is somewhat larger than the number when the view was last rendered, which has arrived from the GPU since
    then. For a new view, it is the number of all anchors.
    """

    _MARGIN, _STEP = 1.25, 4096

    def __init__(self) -> None:
        self._reports: dict[int, tuple[torch.Tensor, torch.cuda.Event | None, int]] = {}

    def of(self, view: int, anchors: int) -> int:
        """Return the limit for a view of a model with this number of anchors."""
        if view not in self._reports:
            return anchors
        count, arrived, then = self._reports[view]
        if arrived is not None and not arrived.query():
            return anchors
        expected = int(count) * anchors / max(then, 1)
        return min(anchors, math.ceil(self._MARGIN * expected / self._STEP + 1) * self._STEP)

    def note(self, view: int, count: torch.Tensor, anchors: int) -> None:
        """Record that `count` () of all `anchors` were in the view."""
        if not count.is_cuda:
            self._reports[view] = (count, None, anchors)
            return
        report = torch.empty((), dtype=count.dtype, pin_memory=True).copy_(count, non_blocking=True)
        arrived = torch.cuda.Event()
        arrived.record()
        self._reports[view] = (report, arrived, anchors)


def strips(
    camera: Camera, image: torch.Tensor, labels: torch.Tensor | None, count: int
) -> list[tuple[Camera, torch.Tensor, torch.Tensor | None]]:
    """Split an image (3, H, W), its labels (H, W) and its camera into `count` strips along its longer side."""
    wide = camera.width >= camera.height
    length = camera.width if wide else camera.height
    edges = [round(i * length / count) for i in range(count + 1)]
    found = []
    for first, last in itertools.pairwise(sorted(set(edges))):
        part = (slice(None), slice(first, last)) if wide else (slice(first, last), slice(None))
        size = last - first
        crop = camera.crop(first, 0, size, camera.height) if wide else camera.crop(0, first, camera.width, size)
        found.append((crop, image[:, *part].contiguous(), None if labels is None else labels[part].contiguous()))
    return found


class ViewStep:
    """Computes the loss of a view and its gradients, in as many parts as the GPU's memory requires.

    Attributes:
        parts: number of parts in which an image is rendered.
        expected_changes: for anchors (n,) int64, the changes of their rows, (n, columns), that are expected before the
            gradients are applied; None if there are none.
    """

    def __init__(
        self,
        scene: Scene,
        settings: Settings,
        model: ObjectModel,
        head_optimizer: HeadAdam,
        growth: GrowthStrategy,
        check: FiniteCheck,
        fits_colors: bool = True,
    ) -> None:
        self.scene = scene
        self.settings = settings
        self.model = model
        self.parts = 1
        self.expected_changes: Callable[[torch.Tensor], torch.Tensor] | None = None
        self._head_optimizer = head_optimizer
        self._growth = growth
        self._check = check
        self.colors = (
            PhotoColors(len(scene.capture), scene.capture.train_indices, model.device) if settings.fit_colors else None
        )
        self._fits_colors = fits_colors
        self._limits = _Limits()
        self._dropout: Dropout | None = None
        self._alone = False
        self._splats: int | torch.Tensor = 0

    @property
    def splats(self) -> int:
        """Number of splats generated in the latest step; synchronizes with the GPU."""
        return int(self._splats)

    @property
    def _has_silhouettes(self) -> bool:
        """Whether unlabeled pixels show the background, so that no object may be drawn there."""
        scene, settings = self.scene, self.settings
        supervised = scene.supervise_background and not scene.zero_is_object
        return supervised and settings.semantic_weight > 0 and settings.mode != "paper"

    def restore(self, tensors: Mapping[str, np.ndarray]) -> None:
        """Restore the corrections of the photos' colors from a checkpoint's tensors."""
        if self.colors is not None:
            self.colors.restore(tensors)

    def expect(self, indices: Sequence[int], progress: float) -> None:
        """Begin to read the photos of the next view and of those that follow, as many as the scene reads ahead."""
        next_ones = indices[: 1 + self.scene.read_ahead]
        self.scene.expect([(index, self._downscale(index, progress)) for index in next_ones])

    def _downscale(self, index: int, progress: float) -> int:
        view = self.scene.capture.views[index]
        return downscale_at(progress, max(view.width, view.height), self.settings.pyramid)

    def largest_downscale(self, progress: float) -> int:
        """Return the factor by which the largest training view is downscaled at a progress of 0 .. 1."""
        return max((self._downscale(index, progress) for index in self.scene.capture.train_indices), default=1)

    def measure_seconds(self, index: int) -> float:
        """Measure how long the gradients of a view take at the start of the training; nothing is changed.

        Args:
            index: index of the view in the capture.

        Raises:
            InputError: as `compute`.
        """
        colors, self.colors = self.colors, None
        self.compute(index, 0.0)  # Read the image.
        # Other clocks may tick as rarely as every 16 ms.
        started = time.perf_counter()
        self.compute(index, 0.0)
        seconds = time.perf_counter() - started
        self.colors = colors
        self._head_optimizer.zero_grad()
        return seconds

    def compute(
        self, index: int, progress: float, dropout: Dropout | None = None, alone: bool = False
    ) -> ViewGradients | None:
        """Compute the loss and gradients of a view; the model is not changed.

        Args:
            index: index of the view in the capture.
            progress: progress of the training, 0 .. 1.
            dropout: leaves out some of the splats.
            alone: also render the objects alone, if this view has a mask that shows the background.

        Returns:
            The loss and gradients; None if no anchor is in view, or if the loss is not finite, whose cause the check
            has then.

        Raises:
            InputError: the GPU's memory is too small for the smallest parts, or the view's image cannot be read.
        """
        self._dropout = dropout
        self._alone = alone and self._has_silhouettes
        gradients, full = self._compute_if_it_fits(index, progress)
        while full:
            self._make_room()
            gradients, full = self._compute_if_it_fits(index, progress)
        return gradients

    def _compute_if_it_fits(self, index: int, progress: float) -> tuple[ViewGradients | None, bool]:
        """Return the result of `_compute`, or None if the GPU's memory was full, and whether it was."""
        try:
            return self._compute(index, progress), False
        except Exception as error:
            if not devices.is_out_of_memory(error):
                raise
            return None, True

    def _make_room(self) -> None:
        """Double the number of parts and release memory, for another attempt at the same view."""
        if self.parts >= MOST_PARTS:
            raise InputError(_NO_ROOM)
        self.parts *= 2
        self._head_optimizer.zero_grad()
        self.scene.forget(shrink=0.5)
        if self.model.device.type == "cuda":
            torch.cuda.empty_cache()

    def _compute(self, index: int, progress: float) -> ViewGradients | None:
        """Compute the loss and gradients of a view in the current number of parts."""
        anchors, on_gpu = self.model.anchors, devices.on_gpu(self.model.anchors.rows)
        downscale = self._downscale(index, progress)
        image, labels = self.scene.target(index, downscale)
        camera = self.scene.camera(index, downscale)
        present = in_view = None
        if on_gpu and self.parts == 1:
            limit = self._limits.of(index, len(anchors))
            seen, present, in_view = first_anchors_in_view(anchors, *frustum(camera), limit)
            self._limits.note(index, in_view, len(anchors))
        else:
            seen = anchors_in_view(anchors, *frustum(camera))
        if len(seen) == 0:
            return None
        self._head_optimizer.zero_grad()
        rows = take_rows(anchors.rows, seen)
        if self.expected_changes is not None:
            rows += self.expected_changes(seen)
        rows.requires_grad_()
        correction = None if self.colors is None else self.colors.of(index).requires_grad_(self._fits_colors)
        losses, splats, statistics = [], [], []
        for part in self._parts_of(camera, image, labels):
            chosen = self._anchors_of(part, seen, rows)
            terms, g, drawn = self._terms(part, *chosen, present, correction, progress)
            of_part = self._total(terms, part)
            if self._check.at_once and not math.isfinite(float(of_part.detach())):
                named = self._split_image_loss(terms, part, drawn, correction)
                self._check.fault = check_finite.find_fault_of_loss(named, g, chosen[0], anchors.layout.offsets)
                return None
            of_part.backward()
            losses.append(of_part.detach())
            splats.append(len(g.source) if g.valid is None else g.valid.sum())
            if self._growth.observes(progress) and drawn.frame.screen_gradient is not None:
                statistics.append(
                    ViewStatistics(
                        chosen[0], g.source, g.opacities.detach(), drawn.frame.seen, drawn.frame.screen_gradient
                    )
                )
        loss, self._splats = sum(losses[1:], start=losses[0]), sum(splats[1:], start=splats[0])
        finite = usable = None
        if present is not None:
            usable, finite, shown = torch.empty_like(present), present.new_empty(()), torch.empty_like(loss)
            kernel("find_usable").for_each(len(seen), loss, present, in_view, len(seen), usable, finite, shown)
            loss = shown
        elif on_gpu:
            finite = loss.isfinite()
            usable, loss = finite.repeat(len(seen)), torch.where(finite, loss, math.nan)
        assert rows.grad is not None
        return ViewGradients(
            (camera.width, camera.height), loss, seen, rows.grad, self._head_optimizer.gradients,
            None if correction is None else correction.grad, in_view, finite, usable,
            ViewStatistics.of_view(statistics, anchors.layout.offsets, usable),
        )  # fmt: skip

    def _parts_of(self, camera: Camera, image: torch.Tensor, labels: torch.Tensor | None) -> Iterator[_Part]:
        """Yield the parts to render; their losses add up to the image's, except for SSIM at the cuts."""
        if self.parts == 1:
            yield _Part(camera, image, labels, 1.0, 1.0)
            return
        for crop, cut, cut_labels in strips(camera, image, labels, self.parts):
            fraction = crop.width * crop.height / (camera.width * camera.height)
            more: float | torch.Tensor = 1.0
            if labels is not None and cut_labels is not None:
                more = (cut_labels >= 0).sum() / ((labels >= 0).sum().clamp(min=1) * fraction)
            yield _Part(crop, cut, cut_labels, fraction, more)

    def _anchors_of(self, part: _Part, seen: torch.Tensor, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the anchors and rows in view of a part, selected from those of the whole image."""
        if self.parts == 1:
            return seen, rows
        a = self.model.anchors
        here = anchors_in_view(
            Anchors(a.layout, a.voxel, a.positions[seen], rows.detach(), a.ids[seen]), *frustum(part.camera)
        )
        return seen[here], rows.index_select(0, here)

    def _terms(
        self,
        part: _Part,
        seen: torch.Tensor,
        rows: torch.Tensor,
        present: torch.Tensor | None,
        correction: torch.Tensor | None,
        progress: float,
    ) -> tuple[dict[str, torch.Tensor], Generated, Rendered]:
        """Render a part from the anchors' rows; returns the weighted loss terms (), the Gaussians and the render."""
        anchors, settings = self.model.anchors, self.settings
        g = generate(
            anchors.layout, anchors.positions[seen], rows, anchors.ids[seen], self.model.heads, part.camera.center,
            present,
        )  # fmt: skip
        if self._dropout is not None:
            g = self._dropout(g)
        flat = settings.primitive == "2d"
        normal_weight, distortion_weight = (
            weight if flat and progress >= SURFACE_FROM else 0.0
            for weight in (settings.normal_weight, settings.distortion_weight)
        )
        drawn = rasterize(
            *g[:6], part.camera, labels=part.labels if settings.semantic_weight else None,
            primitive=settings.primitive, want_depth=normal_weight > 0, want_normals=normal_weight > 0,
            want_distortion=distortion_weight > 0,
        )  # fmt: skip
        terms = {_IMAGE: self._image_loss(part, drawn, drawn.label_probability, correction)}
        if self._alone and part.labels is not None:
            weight = _ALONE * settings.semantic_weight * part.more_labels
            terms["the silhouette loss"] = weight * self._silhouette_loss(g, part.camera, part.labels)
        if settings.volume_weight and len(g.scales):
            terms["the volume loss"] = (
                settings.volume_weight * (0.5 if flat else 1.0) * volume_loss(g.scales, flat, g.valid)
            )
        if drawn.normals is not None and drawn.depth is not None:
            intrinsics = part.camera.arrays()[1]
            terms["the normal loss"] = normal_weight * normal_loss(drawn.normals, drawn.depth, drawn.alpha, intrinsics)
        if drawn.distortion is not None:
            terms["the distortion loss"] = distortion_weight * drawn.distortion.mean()
        return terms, g, drawn

    def _image_loss(
        self, part: _Part, drawn: Rendered, label_probability: torch.Tensor | None, correction: torch.Tensor | None
    ) -> torch.Tensor:
        """Return the loss () of the image, including the label loss if the labels' probability (h, w) is given."""
        color, background = drawn.color, self.model.background
        if correction is not None:
            color, background = corrected(color, background, correction)
        return image_loss(
            color, drawn.alpha, label_probability, background, part.image, part.labels,
            self.settings.ssim_weight, self.settings.semantic_weight * part.more_labels,
        )  # fmt: skip

    def _silhouette_loss(self, g: Generated, camera: Camera, labels: torch.Tensor) -> torch.Tensor:
        """Render the splats of objects without those of the background (class 0), and return the silhouette loss ()."""
        of_objects = g.ids > 0
        # On the GPU, selecting them would synchronize.
        g = g.select(of_objects) if g.valid is None else g._replace(opacities=g.opacities * of_objects)
        return silhouette_loss(rasterize(*g[:6], camera, primitive=self.settings.primitive).alpha, labels)

    def _total(self, terms: dict[str, torch.Tensor], part: _Part) -> torch.Tensor:
        """Return the total loss of a part, weighted by its size."""
        first, *others = terms.values()
        loss = sum(others, start=first)
        return part.fraction * loss if self.parts > 1 else loss

    def _split_image_loss(
        self, terms: dict[str, torch.Tensor], part: _Part, drawn: Rendered, correction: torch.Tensor | None
    ) -> dict[str, torch.Tensor]:
        """Return the terms with the image loss and the label loss separated."""
        with torch.no_grad():
            image = self._image_loss(part, drawn, None, correction)
        labels = torch.where(image.isfinite(), terms[_IMAGE].detach(), 0.0)
        return {**terms, _IMAGE: image, "the label loss": labels}


def frustum(camera: Camera) -> tuple[np.ndarray, np.ndarray, int, int, float]:
    """Return the arguments of `anchors_in_view` for a camera."""
    return (*camera.arrays(), camera.width, camera.height, camera.near)
