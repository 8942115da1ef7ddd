"""Cryptomatte 1.2: object mattes with soft edges in ordinary channels, which compositing programs select by name.

In the specification (Friedman and Jones, 2015), each name is hashed to a float. Each pixel has a list of the hashes of
the objects that cover it most, with their coverage; a layer of four channels has two such pairs. The header has the
names.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

LAYERS = 3
RANKS = 2 * LAYERS
"""Number of objects with a matte in each pixel."""

_MASK = 0xFFFFFFFF


def murmur3(data: bytes) -> int:
    """Compute MurmurHash3_x86_32 with the seed 0."""

    def turned(value: int, bits: int) -> int:
        return (value << bits | value >> 32 - bits) & _MASK

    def mixed(block: bytes) -> int:
        return turned(int.from_bytes(block, "little") * 0xCC9E2D51 & _MASK, 15) * 0x1B873593 & _MASK

    state = 0
    whole = len(data) // 4 * 4
    for at in range(0, whole, 4):
        state = (turned(state ^ mixed(data[at : at + 4]), 13) * 5 + 0xE6546B64) & _MASK
    if whole < len(data):
        state ^= mixed(data[whole:])
    state ^= len(data)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        state = (state ^ state >> shift) * factor & _MASK
    return state ^ state >> 16


def name_bits(name: str) -> int:
    """Return the bits of a name's float: its hash, with an exponent that avoids zeros, infinities and NaN."""
    value = murmur3(name.encode())
    exponent = min(max(value >> 23 & 255, 1), 254)
    return value & 0x807FFFFF | exponent << 23


def header(layer: str, names: Sequence[str]) -> dict[str, str]:
    """Return the attributes of the EXR header for the mattes in `layer`, with the manifest of all names."""
    manifest = {name: f"{name_bits(name):08x}" for name in names}
    key = f"cryptomatte/{murmur3(layer.encode()):08x}"[: len("cryptomatte/") + 7]
    return {
        f"{key}/name": layer,
        f"{key}/hash": "MurmurHash3_32",
        f"{key}/conversion": "uint32_to_float32",
        f"{key}/manifest": json.dumps(manifest, ensure_ascii=False, separators=(",", ":")),
    }


def channels(
    layer: str, names: Sequence[str], ids: NDArray[np.int32], coverage: NDArray[np.float32]
) -> Mapping[str, NDArray[np.float32]]:
    """Return the channels of mattes.

    Args:
        layer: The name of the layer.
        names: The names of the objects.
        ids: (RANKS, H, W) indices in `names`, by descending coverage, -1: none.
        coverage: (RANKS, H, W) of each object, 0 .. 1.

    Returns:
        Channel name -> (H, W) float32.
    """
    hashes = np.array([*(name_bits(name) for name in names), 0], np.uint32).view(np.float32)
    planes = {}
    for number in range(LAYERS):
        for side, (of_id, of_coverage) in enumerate((("R", "G"), ("B", "A"))):
            rank = 2 * number + side
            planes[f"{layer}{number:02d}.{of_id}"] = hashes[ids[rank]]
            planes[f"{layer}{number:02d}.{of_coverage}"] = np.where(ids[rank] >= 0, coverage[rank], 0).astype(
                np.float32
            )
    return planes
