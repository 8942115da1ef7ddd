"""A capture prepared for training: cameras in scene units, images as planes, labels as class indices."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch

from ..gpu.kernel import kernel
from ..model.object_model import Normalization
from ..raster import Camera, devices
from ..shared.class_table import ClassTable
from ..shared.splats.blending import EPS_2D
from .exposure.gains import measure_gains, varies
from .extent import SURROUNDINGS, Extent, extent_of

if TYPE_CHECKING:
    from ..capture import Capture

_Key = tuple[int, int]
"""A view's index, and the factor by which its image is downscaled."""

_Stored = tuple[torch.Tensor, torch.Tensor | None]
"""Image and labels of a view."""

_READ_AHEAD_ON_GPU = 4
"""Number of views that are read, each by a thread, while a GPU trains with others; while the CPU trains, it is one."""

_GPU_FRACTION = 0.25
"""Largest fraction of the GPU's free memory for cached targets."""

_HORIZON = 0.5 * SURROUNDINGS
"""Distance from which on splats belong to surroundings without points, relative to the radius of the capture."""


class Scene:
    """Cameras and targets of a capture.

    Args:
        capture: the views, images and masks.
        classes: class indices of the supervised objects.
        normalization: transform from the capture's world to scene units.
        zero_is_object: whether pixels with ID 0 are supervised as an object.
        memory_mb: memory limit for cached targets; on a GPU, also limited by its free memory.
        supervise_background: whether pixels with ID 0 are supervised to show no object; otherwise they are ignored.
        device: device of the targets.
        gains: (V, 3), brightness of each image relative to the common exposure of the splats. None: estimated, or 1 if
            the exposure of the images does not vary (`exposure_varies`).
        blur: variance of the low-pass filter with which the splats are drawn.
    """

    def __init__(
        self,
        capture: Capture,
        classes: ClassTable,
        normalization: Normalization,
        zero_is_object: bool = False,
        memory_mb: float = 2000,
        supervise_background: bool = False,
        device: torch.device = devices.CPU,
        gains: np.ndarray | None = None,
        blur: float = EPS_2D,
    ) -> None:
        self.capture = capture
        self.classes = classes
        self.normalization = normalization
        self.zero_is_object = zero_is_object
        self.supervise_background = supervise_background or zero_is_object
        if gains is None:
            gains = measure_gains(capture)
            gains = gains if varies(gains) else np.ones_like(gains)
        self.exposure_varies = bool((gains != 1).any())
        self.gains = gains
        self._blur = blur
        self._device = device
        self._budget = memory_mb * 1e6
        if device.type == "cuda":
            self._budget = min(self._budget, _GPU_FRACTION * torch.cuda.mem_get_info(device)[0])
        self._held: OrderedDict[_Key, _Stored] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()
        self._coming: dict[_Key, Future[_Stored]] = {}
        self.read_ahead = 1 if device.type == "cpu" else _READ_AHEAD_ON_GPU
        # Readers run no kernels: where numba has its own threads, as on macOS, kernels of two threads end the process.
        self._readers = ThreadPoolExecutor(self.read_ahead, "read-ahead")

    def camera(self, index: int, downscale: int = 1) -> Camera:
        """Return the camera of `capture.image(index, downscale)` in scene units."""
        view = self.capture.views[index]
        camera = Camera(
            self.normalization.viewmat(view.viewmat),
            view.K,
            view.width,
            view.height,
            blur=self._blur,
            gain=(float(self.gains[index, 0]), float(self.gains[index, 1]), float(self.gains[index, 2])),
        )
        return camera.reduced(downscale)

    def before_surroundings(self, positions: torch.Tensor) -> torch.Tensor:
        """Return which of the positions (n, 3) in scene units are nearer than surroundings without points, bool."""
        center, radius = self._extent
        offsets = positions - devices.upload(self.normalization.to_scene(center[None])[0].astype(np.float32), positions)
        return offsets.square().sum(1) < (_HORIZON * radius * self.normalization.scale) ** 2

    @cached_property
    def _extent(self) -> Extent:
        return extent_of(self.capture)

    def target(self, index: int, downscale: int = 1) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Return the target of a view.

        Returns:
            The image at the common exposure, (3, H, W) float32, and its labels (H, W) int32, -1 where not supervised,
            or None if there is no mask.

        Raises:
            InputError: the image or mask cannot be read.
        """
        pixels, labels = self._stored(index, downscale)
        scale = (1 / (255 * self.gains[index])).astype(np.float32)
        if not devices.on_gpu(pixels):
            factor = torch.from_numpy(scale)[:, None, None]
            return pixels.float() * factor, None if labels is None else labels.int()
        _, height, width = pixels.shape
        image = torch.empty(pixels.shape, device=pixels.device)
        wanted = None if labels is None else torch.empty((height, width), dtype=torch.int32, device=pixels.device)
        kernel("load_target", LABEL="int" if labels is None else _LABELS[labels.dtype]).for_each(
            height * width, pixels, labels, *scale.tolist(), height * width, image, wanted
        )
        return image, wanted

    def expect(self, keys: Sequence[_Key]) -> None:
        """Begin to read the targets that will be asked for: the next one, and `read_ahead` that follow.

        What fails is raised when the target is asked for. Others that were expected before are no longer.
        """
        with self._lock:
            for key in [key for key in self._coming if key not in keys]:
                self._coming.pop(key).cancel()
            for key in keys:
                if key not in self._held and key not in self._coming:
                    self._coming[key] = self._readers.submit(self._read, *key)

    def _read(self, index: int, downscale: int) -> _Stored:
        """Read a view's image (3, H, W) uint8 and labels in few bytes, a quarter of the size of a target."""
        image = self._send(self.capture.image(index, downscale).transpose(2, 0, 1))
        mask = self.capture.mask(index, downscale)
        return image, None if mask is None else self._send(self._labels(mask))

    def _stored(self, index: int, downscale: int) -> _Stored:
        """Return the result of `_read`, which is kept within the memory limit."""
        key = (index, downscale)
        with self._lock:
            if key in self._held:
                self._held.move_to_end(key)
                return self._held[key]
            coming = self._coming.pop(key, None)
        image, labels = self._read(*key) if coming is None else coming.result()
        with self._lock:
            if key not in self._held:
                self._held[key] = (image, labels)
                self._bytes += _size(image, labels)
            while self._bytes > self._budget and len(self._held) > 1:
                _, old = self._held.popitem(last=False)
                self._bytes -= _size(*old)
        return image, labels

    def _send(self, values: np.ndarray) -> torch.Tensor:
        """Copy `values` to the device asynchronously."""
        stored = torch.from_numpy(np.ascontiguousarray(values))
        return stored if self._device.type == "cpu" else stored.pin_memory().to(self._device, non_blocking=True)

    def forget(self, shrink: float = 1.0) -> None:
        """Clear the cache of targets, and multiply its memory limit by `shrink`."""
        self.expect([])
        with self._lock:
            self._held.clear()
            self._bytes = 0
            self._budget *= shrink

    def _labels(self, mask: np.ndarray) -> np.ndarray:
        classes = self.classes.classes_of(mask)
        if not self.supervise_background:
            classes[mask == 0] = -1
        return classes.astype(np.min_scalar_type(-1 - len(self.classes)))


_LABELS = {torch.int8: "signed char", torch.int16: "short", torch.int32: "int"}
"""Types in which labels are stored, and their names in kernels."""


def _size(image: torch.Tensor, labels: torch.Tensor | None) -> int:
    """Return the number of bytes of both."""
    return image.nbytes + (0 if labels is None else labels.nbytes)
