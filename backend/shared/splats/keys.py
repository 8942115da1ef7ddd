"""Keys that identify single splats by the exact bits of their positions and colors, whatever their order."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

NO_KEY = 0
"""The key of no splat, for splats that are not in splats.ply."""

_SEED = np.uint64(0x6F626A6563746773)
_STEP = np.uint64(0x9E3779B97F4A7C15)
_MIX = ((np.uint64(30), np.uint64(0xBF58476D1CE4E5B9)), (np.uint64(27), np.uint64(0x94D049BB133111EB)))


def splat_keys(means: NDArray, colors: NDArray) -> NDArray[np.uint64]:
    """Return the keys of splats, a hash of 64 bits (SplitMix64) of three doubles and three floats.

    Args:
        means: (N, 3) positions in the capture's coordinates, with the precision of splats.ply.
        colors: (N, 3) spherical harmonics coefficients of degree 0.

    Returns:
        (N,) keys, never `NO_KEY`. Splats at the same position with the same color have the same key.
    """
    positions = np.ascontiguousarray(means, np.float64).view(np.uint64)
    shades = np.ascontiguousarray(colors, np.float32).view(np.uint32).astype(np.uint64)
    keys = np.full(len(positions), _SEED)
    for words in (*positions.T, *shades.T):
        keys = (keys ^ words) + _STEP
        for shift, factor in _MIX:
            keys = (keys ^ (keys >> shift)) * factor
        keys ^= keys >> np.uint64(31)
    keys[keys == NO_KEY] = 1
    return keys
