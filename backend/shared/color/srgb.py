"""The sRGB transfer function (IEC 61966-2-1): photos and splats use encoded colors, Blender linear ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

LINEAR_SLOPE = 12.92
GAMMA = 2.4
OFFSET = 0.055
ENCODED_CUTOFF = 0.04045
LINEAR_CUTOFF = 0.0031308
"""Below the cutoffs the function is linear with LINEAR_SLOPE."""


def decode(encoded: ArrayLike) -> NDArray:
    """Convert encoded values, 0 .. 1, of any shape to linear ones; negative values follow the linear segment."""
    encoded = np.asarray(encoded)
    curve = ((np.maximum(encoded, 0.0) + OFFSET) / (1.0 + OFFSET)) ** GAMMA
    return np.where(encoded <= ENCODED_CUTOFF, encoded / LINEAR_SLOPE, curve)


def encode(linear: ArrayLike) -> NDArray:
    """Convert linear values of any shape to encoded ones; the inverse of `decode`."""
    linear = np.asarray(linear)
    curve = (1.0 + OFFSET) * np.maximum(linear, LINEAR_CUTOFF) ** (1.0 / GAMMA) - OFFSET
    return np.where(linear <= LINEAR_CUTOFF, linear * LINEAR_SLOPE, curve)
