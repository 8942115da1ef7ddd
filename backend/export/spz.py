"""Splats as SPZ, version 3: Niantic's compressed format, a fifth of the PLY's size, with Y up. It has no object IDs.

A gzip stream of a header of 16 bytes and, splats together, positions, opacities, colours, scales, rotations and
spherical harmonics, in whole numbers of 8 to 24 bits (https://github.com/nianticlabs/spz).
"""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..model.splats import Splats
from ..protocol import InputError, write_atomic

MAGIC, VERSION = 0x5053474E, 3
_POSITION_LIMIT = 2**23 - 1
_FINEST_BITS = 16
"""More bits behind the point than this are of no use."""
_COLOUR_SCALE = 0.15
_SCALE_STEP, _SMALLEST_LOG = 16.0, -10.0
_LARGEST_LOG = _SMALLEST_LOG + 255 / _SCALE_STEP


def write_spz(path: Path, splats: Splats) -> list[str]:
    """Write `splats` to `path` atomically; returns warnings about what the format cannot hold.

    Positions keep a step of 2^-16 units or, in a large scene, as fine a one as 24 bits allow; scales a step of 6
    percent. Spherical harmonics beyond -1 .. 1 are clamped.
    """
    farthest = float(np.abs(splats.means).max(initial=0.0))
    bits = _FINEST_BITS
    while bits > 0 and farthest * 2**bits > _POSITION_LIMIT:
        bits -= 1
    if farthest * 2**bits > _POSITION_LIMIT:
        raise InputError(
            f"The splats lie up to {farthest:.3g} units from the origin, more than SPZ can hold; export them as PLY."
        )
    header = struct.pack("<IIIBBBB", MAGIC, VERSION, len(splats), splats.degree, bits, 0, 0)
    logs = np.log(splats.scales.astype(np.float64))
    sections = [
        _positions(splats.means, bits),
        _bytes(splats.opacities * 255.0),
        _bytes(splats.sh[:, 0] * (_COLOUR_SCALE * 255.0) + 127.5),
        _bytes((logs - _SMALLEST_LOG) * _SCALE_STEP),
        _rotations(splats.quats),
        _bytes(splats.sh[:, 1:] * 128.0 + 128.0),
    ]
    # No time in it, so that the same splats make the same file.
    write_atomic(path, gzip.compress(header + b"".join(part.tobytes() for part in sections), 9, mtime=0))
    extreme = int(((logs.max(1) < _SMALLEST_LOG) | (logs.max(1) > _LARGEST_LOG)).sum())
    if extreme:
        return [f"{extreme} of {len(splats)} splats are smaller or larger than {path.name} can hold, and were clamped."]
    return []


def _bytes(values: NDArray) -> NDArray[np.uint8]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _positions(means: NDArray, bits: int) -> NDArray[np.uint8]:
    """(N, 3) -> (N, 3, 3): signed whole numbers of 24 bits."""
    fixed = np.rint(means.astype(np.float64) * 2**bits).astype("<i4")
    return fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3]


def _rotations(quats: NDArray) -> NDArray:
    """(N, 4) wxyz -> (N,) of 32 bits: which of x, y, z, w is the largest, and sign and size of the others."""
    xyzw = quats[:, [1, 2, 3, 0]].astype(np.float64)
    largest = np.abs(xyzw).argmax(1)
    xyzw *= np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -1.0, 1.0)
    packed = largest.astype(np.uint32)
    for axis in range(4):
        size = np.rint(np.abs(xyzw[:, axis]) * (np.sqrt(2.0) * 511.0)).astype(np.uint32)
        with_axis = packed << 10 | (xyzw[:, axis] < 0).astype(np.uint32) << 9 | np.minimum(size, 511)
        packed = np.where(largest == axis, packed, with_axis)
    return packed.astype("<u4")
