"""Affine corrections of the photos' colors, fitted in training.

A photo may be brighter, warmer or flatter than the others, since the camera chooses exposure and white balance, and
processes the picture. Photo i is compared with exp(a_i) render + b_i in each channel, where the log gain a_i and the
offset b_i are fitted together with the splats. `gains` supplies the first approximation; here the rest is fitted,
from all pixels. Gains and offsets have a mean of 0 over the views trained on so far, as the splats could absorb a
common one, and are drawn toward 0, so that photos of constant exposure keep none.

Held-out views and new cameras have no correction.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from ...model.draw import draw
from ..optimizer.adam import BETA1, BETA2
from ..settings import rate

if TYPE_CHECKING:
    from ...model.object_model import ObjectModel
    from ..scene import Scene

RATES = (5e-3, 5e-4)
"""Learning rate of the corrections at the start and the end of the training."""

_MOST = math.log(4)
"""Largest log gain that is fitted at once."""

PULL = 0.01
"""Weight of the square of the corrections, relative to the loss of the image."""

NAMES = ("values", "exp_avg", "exp_avg_sq", "steps")
"""Names of the tensors of `PhotoColors`; all but the last have the shape (V, 2, 3)."""

_PREFIX = "colors."


class PhotoColors:
    """Corrections of V photos and their Adam moments.

    Args:
        count: number of photos of the capture.
        fitted: indices of the photos whose corrections are fitted.
        device: device of the corrections.

    Attributes:
        values: (V, 2, 3) float32, log gain and offset of each photo in RGB.
        exp_avg, exp_avg_sq: (V, 2, 3) float32, their moments.
        steps: (V,) float32, number of steps of each photo.
    """

    def __init__(self, count: int, fitted: Sequence[int], device: torch.device) -> None:
        self.values = torch.zeros((count, 2, 3), device=device)
        self.exp_avg = torch.zeros_like(self.values)
        self.exp_avg_sq = torch.zeros_like(self.values)
        self.steps = torch.zeros(count, device=device)
        self._fitted = torch.tensor(list(fitted), dtype=torch.int64, device=device)

    def of(self, index: int) -> torch.Tensor:
        """Return a copy of the correction (2, 3) of a photo, to which a gradient can be accumulated."""
        return self.values[index].clone().requires_grad_()

    def step(self, index: int, gradient: torch.Tensor, progress: float, finite: torch.Tensor | None = None) -> None:
        """Update the correction of a photo, unless the gradient is not finite.

        Args:
            index: index of the photo.
            gradient: (2, 3), the gradient of the loss.
            progress: progress of the training, 0 .. 1.
            finite: () bool; where it is False, nothing changes.
        """
        gradient = gradient + 2 * PULL * self.values[index]
        usable = gradient.isfinite().all()
        if finite is not None:
            usable = usable & finite
        steps = self.steps[index] + 1
        exp_avg = torch.lerp(gradient, self.exp_avg[index], BETA1)
        exp_avg_sq = torch.lerp(gradient * gradient, self.exp_avg_sq[index], BETA2)
        mean = exp_avg / (1 - BETA1**steps)
        spread = (exp_avg_sq / (1 - BETA2**steps)).sqrt() + 1e-15
        changed = self.values[index] - rate(RATES, progress) * mean / spread
        for stored, value in (
            (self.steps, steps), (self.exp_avg, exp_avg), (self.exp_avg_sq, exp_avg_sq), (self.values, changed)
        ):  # fmt: skip
            stored[index] = torch.where(usable, value, stored[index])
        # Photos that are spared so far would only drift away, since no step of their own draws them back.
        trained = (self.steps[self._fitted] > 0).to(self.values)[:, None, None]
        fitted = self.values[self._fitted]
        mean = (fitted * trained).sum(dim=0) / trained.sum().clamp(min=1)
        self.values[self._fitted] = fitted - mean * trained

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the corrections and moments as tensors for a checkpoint."""
        return {_PREFIX + name: getattr(self, name) for name in NAMES}

    def restore(self, tensors: Mapping[str, np.ndarray]) -> None:
        """Restore corrections and moments from a checkpoint's tensors.

        They remain as they are for checkpoints of versions without corrections, and of another number of photos.
        """
        for name in NAMES:
            stored, found = getattr(self, name), tensors.get(_PREFIX + name)
            if found is not None and found.shape == tuple(stored.shape):
                stored.copy_(torch.from_numpy(found.copy()))


def begin_colors(colors: PhotoColors | None, model: ObjectModel, scene: Scene, indices: Sequence[int]) -> None:
    """Fit the corrections of views to renders, where they join a training that has not seen them so far.

    Args:
        colors: the corrections, changed in place; None: photos have none.
        model: the model as trained so far.
        scene: the scene with the photos.
        indices: the views.

    Raises:
        InputError: a photo cannot be read.
    """
    if colors is None:
        return
    for index in indices:
        render = draw(model, scene.camera(index), want_ids=False).image
        found = fit_correction(render, scene.capture.image(index) / 255)
        # Both are at the photo's exposure; in training, at the common one.
        found[1] /= scene.gains[index]
        colors.values[index] = torch.from_numpy(found).to(colors.values)


def fit_correction(render: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Fit log gain and offset of each channel to a photo, with the least squared error over all pixels.

    Args:
        render, photo: (H, W, 3), 0 .. 1.

    Returns:
        (2, 3) float32; the log gain is limited, and 0 where the render has one color.
    """
    colors, wanted = render.reshape(-1, 3).astype(np.float64), photo.reshape(-1, 3).astype(np.float64)
    mean, wanted_mean = colors.mean(0), wanted.mean(0)
    spread = ((colors - mean) ** 2).mean(0)
    gain = ((colors - mean) * (wanted - wanted_mean)).mean(0) / np.maximum(spread, 1e-12)
    gain = np.where(spread > 1e-6, np.clip(gain, math.exp(-_MOST), math.exp(_MOST)), 1.0)
    return np.stack([np.log(gain), wanted_mean - gain * mean]).astype(np.float32)


def corrected(
    color: torch.Tensor, background: torch.Tensor, correction: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Apply the correction of a photo to a render in front of a background.

    Args:
        color: (3, H, W), the render; the background is to be added with a weight of 1 - alpha.
        background: (3,) RGB.
        correction: (2, 3), log gain and offset.

    Returns:
        Both after the correction, so that their sum is exp(a) (color + (1 - alpha) background) + b.
    """
    gain, offset = correction[0].exp(), correction[1]
    return torch.addcmul(offset[:, None, None], color, gain[:, None, None]), background * gain
