"""Export of splats as SPZ, version 3: Niantic's compressed format, Y up, a fifth of the PLY's size, no object IDs.

A gzip stream of a 16-byte header, followed by the positions, opacities, colors, scales, rotations and spherical
harmonics of all splats as integers of 8 to 24 bits (https://github.com/nianticlabs/spz).
"""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..model.splats import Splats
from ..shared.errors import InputError
from ..shared.formats.atomic import write_atomic

MAGIC, VERSION = 0x5053474E, 3
_POSITION_LIMIT = 2**23 - 1
_FINEST_BITS = 16
"""Largest number of fractional bits of a position."""
_COLOR_SCALE = 0.15
_SCALE_STEP, _SMALLEST_LOG = 16.0, -10.0
_LARGEST_LOG = _SMALLEST_LOG + 255 / _SCALE_STEP


def write_spz(path: Path, splats: Splats) -> list[str]:
    """Write splats as SPZ, atomically.

    Positions are rounded to 2^-16 units or, in large scenes, to 24 bits; scales to 6 percent. Spherical harmonics are
    clamped to -1 .. 1.

    Args:
        path: The file to write.
        splats: The splats, Y up.

    Returns:
        A warning about splats whose scales were clamped.

    Raises:
        InputError: The splats are too far from the origin.
    """
    farthest = float(np.abs(splats.means).max(initial=0.0))
    bits = _FINEST_BITS
    while bits > 0 and farthest * 2**bits > _POSITION_LIMIT:
        bits -= 1
    if farthest * 2**bits > _POSITION_LIMIT:
        raise InputError(
            f"The splats lie up to {farthest:.3g} units from the origin, too far for SPZ; export them as PLY."
        )
    header = struct.pack("<IIIBBBB", MAGIC, VERSION, len(splats), splats.degree, bits, 0, 0)
    logs = np.log(splats.scales.astype(np.float64))
    sections = [
        _positions(splats.means, bits),
        _bytes(splats.opacities * 255.0),
        _bytes(splats.sh[:, 0] * (_COLOR_SCALE * 255.0) + 127.5),
        _bytes((logs - _SMALLEST_LOG) * _SCALE_STEP),
        _rotations(splats.quats),
        _bytes(splats.sh[:, 1:] * 128.0 + 128.0),
    ]
    # No time stamp, so that the same splats produce the same file.
    write_atomic(path, gzip.compress(header + b"".join(part.tobytes() for part in sections), 9, mtime=0))
    extreme = int(((logs.max(1) < _SMALLEST_LOG) | (logs.max(1) > _LARGEST_LOG)).sum())
    if extreme:
        return [
            f"{extreme} of {len(splats)} splats are too small or too large for {path.name}; their scales were clamped."
        ]
    return []


def _bytes(values: NDArray) -> NDArray[np.uint8]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _positions(means: NDArray, bits: int) -> NDArray[np.uint8]:
    """Return positions (N, 3) as signed integers of 24 bits, (N, 3, 3) bytes."""
    fixed = np.rint(means.astype(np.float64) * 2**bits).astype("<i4")
    return fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3]


def _rotations(quats: NDArray) -> NDArray:
    """Pack quaternions (N, 4) wxyz into 32 bits, (N,): the index of the largest component, and the other three."""
    xyzw = quats[:, [1, 2, 3, 0]].astype(np.float64)
    largest = np.abs(xyzw).argmax(1)
    xyzw *= np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -1.0, 1.0)
    packed = largest.astype(np.uint32)
    for axis in range(4):
        size = np.rint(np.abs(xyzw[:, axis]) * (np.sqrt(2.0) * 511.0)).astype(np.uint32)
        with_axis = packed << 10 | (xyzw[:, axis] < 0).astype(np.uint32) << 9 | np.minimum(size, 511)
        packed = np.where(largest == axis, packed, with_axis)
    return packed.astype("<u4")
