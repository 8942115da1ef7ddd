"""HDR video as sRGB: the transfer functions of ITU-R BT.2100, and its primaries."""

from __future__ import annotations

import numpy as np

from .srgb import encode

WHITE_NITS = 203.0
"""Luminance of white in HDR pictures beside SDR ones (ITU-R BT.2408)."""

_HLG_WHITE = 0.75
"""HLG signal of that white."""
_KNEE = 0.8
"""Linear value from which on highlights are compressed, so that those above white keep differences."""
_TO_BT709 = np.array([
    [1.660491, -0.587641, -0.072850],
    [-0.124550, 1.132900, -0.008349],
    [-0.018151, -0.100579, 1.118730],
])  # fmt: skip
"""Linear BT.2020 to linear BT.709 (ITU-R BT.2087)."""


def pq_to_linear(signal: np.ndarray) -> np.ndarray:
    """Return linear light of a PQ signal 0 .. 1 (SMPTE ST 2084), where white is 1."""
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 4096 * 128, 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
    power = np.clip(signal, 0.0, 1.0) ** (1 / m2)
    return 10000.0 / WHITE_NITS * (np.maximum(power - c1, 0.0) / (c2 - c3 * power)) ** (1 / m1)


def hlg_to_linear(signal: np.ndarray) -> np.ndarray:
    """Return linear light of an HLG signal 0 .. 1 (ITU-R BT.2100), where white is 1."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073

    def scene_light(values: np.ndarray) -> np.ndarray:
        return np.where(values <= 0.5, values**2 / 3, (np.exp((values - c) / a) + b) / 12)

    return scene_light(np.clip(signal, 0.0, 1.0)) / scene_light(np.array(_HLG_WHITE))


def to_srgb(linear: np.ndarray, wide: bool = True) -> np.ndarray:
    """Return linear light as sRGB values.

    Args:
        linear: (..., 3), where white is 1 and highlights may exceed it.
        wide: whether its primaries are those of BT.2020 instead of BT.709.

    Returns:
        (..., 3) in 0 .. 1; highlights above the knee are compressed smoothly.
    """
    values = np.maximum(linear @ _TO_BT709.T if wide else linear, 0.0)
    above = np.maximum(values - _KNEE, 0.0) / (1 - _KNEE)
    return encode(np.where(values > _KNEE, _KNEE + (1 - _KNEE) * (1 - np.exp(-above)), values))
