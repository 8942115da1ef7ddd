"""Masks of prompts in several pictures, which are encoded once."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable

import numpy as np

from .segmenter import Encoded, Segmenter

_KEPT = 16
"""Number of pictures whose encodings are kept in memory; each takes up to 20 MB."""


class KeptEncodings:
    """Segments pictures by prompts, and keeps the encodings of the latest pictures."""

    def __init__(self, segmenter: Segmenter) -> None:
        self._segmenter = segmenter
        self._encoded: OrderedDict[Hashable, Encoded] = OrderedDict()

    def __call__(
        self, key: Hashable, picture: Callable[[], np.ndarray], points: np.ndarray, labels: np.ndarray
    ) -> np.ndarray:
        """Return the mask of what points mark.

        Args:
            key: identifies the picture.
            picture: returns it, (H, W, 3) uint8.
            points: (n, 2) x and y in pixels, with the center of the first pixel at (0.5, 0.5).
            labels: (n,) 1 for points on the object, 0 for points that are not on it.

        Returns:
            (H, W) bool.
        """
        if key not in self._encoded:
            self._encoded[key] = self._segmenter.encode(picture())
        self._encoded.move_to_end(key)
        if len(self._encoded) > _KEPT:
            self._encoded.popitem(last=False)
        return self._segmenter.segment(self._encoded[key], points, labels)[0]
