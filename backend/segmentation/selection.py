"""Prompts all over a photo, and which of their masks are segments: good and stable ones (Kirillov et al. 2023)."""

from __future__ import annotations

import numpy as np
import torch

GRID = 16
"""Number of prompts in a row and in a column of the photo."""
LEAST_IOU, LEAST_STABILITY = 0.8, 0.95
"""Least IoU that the model predicts for a mask, and least IoU of the mask at two thresholds."""

_OFFSET = 1.0
"""Difference of these thresholds from that of the mask, in logits."""
_SMALLEST, _LARGEST = 5e-4, 0.9
"""Fractions of the photo's pixels: smaller masks are noise, and larger ones are the photo rather than an object."""
_SAME = 0.7
"""Two masks with a larger IoU are one segment."""


def grid_points(size: tuple[int, int]) -> np.ndarray:
    """Return the prompts (n, 2), x and y in pixels, for a photo of this size (width, height), row by row."""
    along = (np.arange(GRID) + 0.5) / GRID
    x, y = np.meshgrid(along * size[0], along * size[1])
    return np.column_stack([x.ravel(), y.ravel()])


def is_segment(logits: torch.Tensor, scores: torch.Tensor) -> torch.Tensor:
    """Return (n,) bool whether masks with logits (n, h, w) and predicted IoUs (n,) are segments."""
    narrow, inside, wide = ((logits > offset).flatten(1).sum(1) for offset in (_OFFSET, 0.0, -_OFFSET))
    pixels = logits.shape[1] * logits.shape[2]
    stable = narrow >= LEAST_STABILITY * wide
    return (scores >= LEAST_IOU) & stable & (inside >= max(_SMALLEST * pixels, 1)) & (inside <= _LARGEST * pixels)


def distinct(masks: np.ndarray, scores: np.ndarray) -> list[int]:
    """Return the indices of masks (n, h, w) bool without duplicates, the best of each by its score, large to small."""
    bits = np.packbits(masks.reshape(len(masks), masks[0].size if len(masks) else 0), axis=1)
    areas = masks.sum((1, 2))
    kept: list[int] = []
    for index in np.argsort(-scores, kind="stable").tolist():
        common = np.bitwise_count(bits[kept] & bits[index]).sum(1, dtype=np.int64)
        if not (common > _SAME * (areas[kept] + areas[index] - common)).any():
            kept.append(index)
    return sorted(kept, key=lambda index: (-int(areas[index]), index))
