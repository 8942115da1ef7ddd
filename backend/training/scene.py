"""A capture as training sees it: normalised cameras, pictures as planes, labels as class indices."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import TYPE_CHECKING

import numpy as np
import torch

from .. import device
from ..model.object_model import Normalization
from ..raster import Camera
from .exposure import measure_gains, varies

if TYPE_CHECKING:
    from ..capture import Capture

_SHARE_OF_GPU = 0.25
"""Of the GPU's free memory, at most this share holds targets."""


class Scene:
    """Cameras and targets of a capture for the classes `object_ids` ((C,) int64, ascending, 0 first).

    teach_unlabelled: pixels of ID 0 are taught to show no object; otherwise nothing is taught there.
    gains (V, 3): by how much brighter each photo is than the exposure that the splats are to have; measured where None
    is given, and 1 where the photos' exposure does not vary (`exposure_varies`).
    Targets lie on the device `place`, as many as memory_mb and the device have room for.
    """

    def __init__(
        self,
        capture: Capture,
        object_ids: np.ndarray,
        normalization: Normalization,
        zero_is_object: bool = False,
        memory_mb: float = 2000,
        teach_unlabelled: bool = False,
        place: torch.device = device.CPU,
        gains: np.ndarray | None = None,
    ) -> None:
        self.capture = capture
        self.object_ids = object_ids
        self.normalization = normalization
        self.zero_is_object = zero_is_object
        self.teach_unlabelled = teach_unlabelled or zero_is_object
        if gains is None:
            gains = measure_gains(capture)
            gains = gains if varies(gains) else np.ones_like(gains)
        self.exposure_varies = bool((gains != 1).any())
        self.gains = gains
        self._place = place
        self._budget = memory_mb * 1e6
        if place.type == "cuda":
            self._budget = min(self._budget, _SHARE_OF_GPU * torch.cuda.mem_get_info(place)[0])
        self._held: OrderedDict[tuple[int, int], tuple[torch.Tensor, torch.Tensor | None]] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def camera(self, index: int, downscale: int = 1) -> Camera:
        """A view's camera in scene units."""
        view = self.capture.views[index]
        return Camera(
            self.normalization.viewmat(view.viewmat),
            self.capture.K(index, downscale),
            view.width // downscale,
            view.height // downscale,
            gain=(float(self.gains[index, 0]), float(self.gains[index, 1]), float(self.gains[index, 2])),
        )

    def target(self, index: int, downscale: int = 1) -> tuple[torch.Tensor, torch.Tensor | None]:
        """A view's picture at the common exposure, (3, H, W) float32, and its labels (H, W) int32, -1 = not taught."""
        key = (index, downscale)
        with self._lock:
            if key in self._held:
                self._held.move_to_end(key)
                return self._held[key]
        picture = self._picture(index, downscale)
        mask = self.capture.mask(index, downscale)
        labels = None if mask is None else self._sent(torch.from_numpy(self._classes(mask)))
        size = picture.numel() * 4 + (0 if labels is None else labels.numel() * 4)
        with self._lock:
            self._held[key] = (picture, labels)
            self._bytes += size
            while self._bytes > self._budget and len(self._held) > 1:
                _, (old, old_labels) = self._held.popitem(last=False)
                self._bytes -= old.numel() * 4 + (0 if old_labels is None else old_labels.numel() * 4)
        return picture, labels

    def _picture(self, index: int, downscale: int) -> torch.Tensor:
        pixels = self.capture.image(index, downscale)
        scale = (1 / (255 * self.gains[index])).astype(np.float32)
        if self._place.type == "cpu":
            planes = np.ascontiguousarray(pixels.transpose(2, 0, 1), np.float32)
            return torch.from_numpy(planes * scale[:, None, None])
        # As bytes, a quarter of what the planes take.
        sent = self._sent(torch.from_numpy(np.ascontiguousarray(pixels)))
        return sent.permute(2, 0, 1).float().contiguous() * device.upload(scale, sent)[:, None, None]

    def _sent(self, values: torch.Tensor) -> torch.Tensor:
        """`values` on the device; the processor goes on before they are there."""
        return values if self._place.type == "cpu" else values.pin_memory().to(self._place, non_blocking=True)

    def forget(self, shrink: float = 1.0) -> None:
        """Give the held pictures' memory back, and hold only `shrink` times as much from now on."""
        with self._lock:
            self._held.clear()
            self._bytes = 0
            self._budget *= shrink

    def _classes(self, mask: np.ndarray) -> np.ndarray:
        place = np.clip(np.searchsorted(self.object_ids, mask), 0, len(self.object_ids) - 1)
        known = self.object_ids[place] == mask
        if not self.teach_unlabelled:
            known &= mask != 0
        return np.where(known, place, -1).astype(np.int32)
