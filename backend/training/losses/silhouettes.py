"""The loss of objects that reach beyond their masks, which shows only in renders without the rest of the scene.

Renders of the whole scene do not tell what is hidden behind other splats. Splats of an object may therefore reach far
beyond it, such as below the cloth that it lies on, which shows as soon as the object is moved. Where a mask shows the
background, however, a splat of an object on the ray either does not belong there or is hidden by something without an
ID. The weight of the loss is therefore low: splats that other photos show are held by these, those that none shows are
held by nothing.
"""

from __future__ import annotations

import torch

from .on_cpu import PROBABILITY_FLOOR


def silhouette_loss(alpha: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
    """Compute the label loss of a render of the objects alone, over the pixels that show the background.

    A pixel with alpha a shows the background with the probability 1 - a. The loss is
    -mean log((1 - a + f) / (1 + f)) with f = PROBABILITY_FLOOR, where pixels with other labels add 0 to the mean.

    Args:
        alpha: (H, W), rendered from the objects' splats alone.
        labels: (H, W) int32; 0 is the background, -1 is ignored.

    Returns:
        () float32; 0 if no pixel is labeled.
    """
    empty = (1 - alpha + PROBABILITY_FLOOR) / (1 + PROBABILITY_FLOOR)
    return -torch.where(labels == 0, empty, 1.0).log().sum() / (labels >= 0).sum().clamp(min=1)
