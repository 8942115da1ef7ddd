"""Sparse voxel grid: blocks of 8 x 8 x 8 samples, allocated only near a surface."""

from __future__ import annotations

import itertools

import numpy as np

SIDE = 8
"""Number of samples along a block's edge."""
SAMPLES = SIDE**3

LOCAL = np.stack(np.unravel_index(np.arange(SAMPLES), (SIDE,) * 3), 1)
"""(512, 3): the positions of the samples in a block."""

AROUND = np.array([o for o in itertools.product((-1, 0, 1), repeat=3) if o != (0, 0, 0)], np.int64)
"""(26, 3): the offsets to the neighbors of a block."""

_HALF = 1 << 19
_FARTHEST = _HALF - 2


def pack(coords: np.ndarray) -> np.ndarray:
    """Pack integer triples (..., 3), each within half a million of 0, into one int64."""
    c = np.asarray(coords, np.int64) + _HALF
    return (c[..., 0] << 42) | (c[..., 1] << 21) | c[..., 2]


def unpack(keys: np.ndarray) -> np.ndarray:
    """Undo `pack`: (..., 3) int64."""
    mask = (1 << 21) - 1
    return np.stack([keys >> 42, (keys >> 21) & mask, keys & mask], -1) - _HALF


def distinct(coords: np.ndarray) -> np.ndarray:
    """Return the unique triples (n, 3) int64 in the order of their keys, without those out of the range of `pack`."""
    near = (np.abs(coords) < _FARTHEST).all(-1)
    return unpack(np.unique(pack(coords[near])))


class Blocks:
    """The blocks coords (B, 3) int64; sample (i, j, k) of block c lies at grid point 8 c + (i, j, k)."""

    def __init__(self, coords: np.ndarray) -> None:
        self.coords = np.asarray(coords, np.int64).reshape(-1, 3)
        self._keys = pack(self.coords)
        self._order = np.argsort(self._keys)
        self._sorted = self._keys[self._order]

    def __len__(self) -> int:
        return len(self.coords)

    def find(self, coords: np.ndarray) -> np.ndarray:
        """Return the index of each block in `coords` (..., 3), -1 if it does not exist."""
        keys = pack(np.clip(coords, -_FARTHEST, _FARTHEST))
        if not len(self):
            return np.full(keys.shape, -1, np.int64)
        place = np.minimum(np.searchsorted(self._sorted, keys), len(self) - 1)
        return np.where(self._sorted[place] == keys, self._order[place], -1)

    def joined(self, coords: np.ndarray) -> Blocks:
        """Return these blocks followed by `coords`, which must be new."""
        return Blocks(np.concatenate([self.coords, coords]))
