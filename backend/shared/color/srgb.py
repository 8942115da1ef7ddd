"""The sRGB transfer function (IEC 61966-2-1): photos and splats hold encoded colors, Blender holds linear ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

LINEAR_SLOPE = 12.92
GAMMA = 2.4
OFFSET = 0.055
ENCODED_CUTOFF = 0.04045
LINEAR_CUTOFF = 0.0031308
"""Below the cutoffs the function is a line of LINEAR_SLOPE."""


def decode(encoded: ArrayLike) -> NDArray:
    """Encoded values, 0 .. 1, of any shape -> linear ones; negative values go along the line."""
    encoded = np.asarray(encoded)
    curve = ((np.maximum(encoded, 0.0) + OFFSET) / (1.0 + OFFSET)) ** GAMMA
    return np.where(encoded <= ENCODED_CUTOFF, encoded / LINEAR_SLOPE, curve)


def encode(linear: ArrayLike) -> NDArray:
    """Linear values, of any shape -> encoded ones; the inverse of `decode`."""
    linear = np.asarray(linear)
    curve = (1.0 + OFFSET) * np.maximum(linear, LINEAR_CUTOFF) ** (1.0 / GAMMA) - OFFSET
    return np.where(linear <= LINEAR_CUTOFF, linear * LINEAR_SLOPE, curve)
