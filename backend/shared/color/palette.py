"""One color for each object ID, the same in images, in reports and in Blender."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from .srgb import decode, encode

UNLABELED = (58, 58, 62)
"""Color of ID 0, no object: dark gray."""

_FIRST = (
    "3b7dd8 f07f1c 3fa34d e0454f 9a63d6 f6d236 22b8c2 f078b8 9c6b3f a8d04a 00806e "
    "b9b0f5 8f2f6b ffb08a 7b8d1e 4a4fb8 8fe3b0 c2502a d94fd0 8ecbf5 e3d79a b0576f"
)
_FIRST_RGB = np.array([tuple(bytes.fromhex(word)) for word in _FIRST.split()], np.uint8)

# Successive multiples of these, modulo 1, fill a cube evenly, so that close IDs get distinct colors.
_STEPS = (0.8191725133961645, 0.6710436067037893, 0.5497004779019703)


def colors_of(ids: NDArray | Iterable[int]) -> NDArray[np.uint8]:
    """Return the colors (n, 3) uint8 sRGB of IDs (n,) up to 2^32 - 1; each color depends only on its own ID."""
    ids = np.asarray(ids if isinstance(ids, np.ndarray) else list(ids), np.int64).reshape(-1)
    hue, gray, dark = (np.modf(np.abs(ids) * step)[0] for step in _STEPS)
    out = _from_hsv(hue, 0.45 + 0.45 * gray, 0.62 + 0.36 * dark)
    first = (ids >= 1) & (ids <= len(_FIRST_RGB))
    out[first] = _FIRST_RGB[ids[first] - 1]
    out[ids == 0] = UNLABELED
    return out


def _from_hsv(hue: NDArray, saturation: NDArray, value: NDArray) -> NDArray[np.uint8]:
    """Convert HSV arrays (n,) in 0 .. 1 to RGB (n, 3) uint8, as colorsys.hsv_to_rgb does."""
    sector = (np.array([[5.0, 3.0, 1.0]]) + 6.0 * hue[:, None]) % 6.0
    part = np.clip(np.minimum(sector, 4.0 - sector), 0.0, 1.0)
    return np.rint(255.0 * value[:, None] * (1.0 - saturation[:, None] * part)).astype(np.uint8)


def object_colors(ids: Iterable[int]) -> dict[int, tuple[int, int, int]]:
    """Map IDs to their colors (red, green, blue), sRGB 0 .. 255."""
    ids = [int(i) for i in ids]
    return {i: (int(r), int(g), int(b)) for i, (r, g, b) in zip(ids, colors_of(ids))}


def to_linear(rgb: Iterable[int]) -> tuple[float, ...]:
    """Convert sRGB 0 .. 255 to linear 0 .. 1, as in Blender's color properties of objects and materials."""
    return tuple(decode(np.array(list(rgb)) / 255.0).tolist())


def to_encoded(linear: Iterable[float]) -> tuple[float, ...]:
    """Convert linear 0 .. 1 to sRGB 0 .. 1, as in photos and splats."""
    return tuple(encode(np.array(list(linear))).tolist())
