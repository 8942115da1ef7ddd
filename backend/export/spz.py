"""Export of splats as SPZ, version 3, and import, versions 2 and 3: Niantic's compressed format, Y up, a fifth of the
PLY's size, no object IDs.

A gzip stream of a 16-byte header, followed by the positions, opacities, colors, scales, rotations and spherical
harmonics of all splats as integers of 8 to 24 bits (https://github.com/nianticlabs/spz).
"""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..model.splats import Splats
from ..shared.errors import InputError
from ..shared.formats.atomic import write_atomic
from ..shared.formats.regular_file import read_regular
from ..shared.splats.blending import EPS_2D, USUAL_EPS_2D
from .ply import DEGREE_KEPT, cleaned, degree_warnings, rounding_warnings

DOWN_TO_UP = np.diag([1.0, -1.0, -1.0, 1.0])
"""From the axes of COLMAP (x right, y down, z forward) to those of SPZ (x right, y up, z back), and back."""

MAGIC, VERSION = 0x5053474E, 3
_READABLE = (2, 3)
_HEADER = struct.Struct("<IIIBBBB")
_POSITION_LIMIT = 2**23 - 1
_FINEST_BITS = 16
"""Largest number of fractional bits of a position."""
_COLOR_SCALE = 0.15
_SCALE_STEP, _SMALLEST_LOG = 16.0, -10.0
_LARGEST_LOG = _SMALLEST_LOG + 255 / _SCALE_STEP
_MOST_SPLATS = 10_000_000
"""Number of splats that Niantic's own reader accepts at most; it limits what a small file can expand to."""
_MOST_BITS, _HIGHEST_DEGREE = 24, 4
_ANTIALIASED = 1
"""Flag of splats that were trained with antialiasing."""


def write_spz(path: Path, splats: Splats) -> list[str]:
    """Write splats as SPZ, atomically.

    Positions are rounded to 2^-16 units or, in large scenes, to 24 bits; scales to 6 percent. Spherical harmonics are
    clamped to -1 .. 1.

    Args:
        path: The file to write.
        splats: The splats, Y up.

    Returns:
        Warnings about positions that were rounded, and about splats whose scales were clamped.

    Raises:
        InputError: The splats are too far from the origin, or more than readers accept.
    """
    if len(splats) > _MOST_SPLATS:
        raise InputError(
            f"{len(splats):,} splats are more than the {_MOST_SPLATS:,} that readers of SPZ accept; export fewer of "
            "them, or as PLY."
        )
    farthest = float(np.abs(splats.means).max(initial=0.0))
    bits = _FINEST_BITS
    while bits > 0 and farthest * 2**bits > _POSITION_LIMIT:
        bits -= 1
    if farthest * 2**bits > _POSITION_LIMIT:
        raise InputError(
            f"The splats lie up to {farthest:.3g} units from the origin, too far for SPZ; export them as PLY."
        )
    header = _HEADER.pack(MAGIC, VERSION, len(splats), splats.degree, bits, 0, 0)
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
    reason = "; scale them up, or export as PLY." if bits == _FINEST_BITS else None
    warnings = rounding_warnings(path, splats, 2.0**-bits, reason)
    extreme = int(((logs.max(1) < _SMALLEST_LOG) | (logs.max(1) > _LARGEST_LOG)).sum())
    if extreme:
        warnings.append(
            f"{extreme} of {len(splats)} splats are too small or too large for {path.name}; their scales were clamped."
        )
    return warnings


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


def read_spz(path: Path) -> tuple[Splats, list[str]]:
    """Read splats from an SPZ file, written by this or another program.

    Args:
        path: The file to read.

    Returns:
        The splats as they are in the file, Y up and without objects, and warnings about what was dropped.

    Raises:
        InputError: The file cannot be read, is damaged, or has another version.
    """
    count, degree, bits, flags, version, data = _unpack(path)
    quat_size = 3 if version == 2 else 4
    rest = (degree + 1) ** 2 - 1
    sections, at = [], _HEADER.size
    for size in (9, 1, 3, 3, quat_size, 3 * rest):
        sections.append(np.frombuffer(data, np.uint8, count * size, at).reshape(count, size))
        at += count * size
    positions, alphas, colors, scales, rotations, others = sections
    fixed = np.zeros((count, 3, 4), np.uint8)
    fixed[..., 1:] = positions.reshape(count, 3, 3)
    # The lowest byte is empty, so that the sign is that of the 32 bits.
    means = (fixed.view("<i4")[..., 0] / 2.0 ** (8 + bits)).astype(np.float32)
    kept = (min(degree, DEGREE_KEPT) + 1) ** 2
    sh = np.empty((count, kept, 3), np.float32)
    sh[:, 0] = (colors / 255.0 - 0.5) / _COLOR_SCALE
    sh[:, 1:] = (others.reshape(count, rest, 3)[:, : kept - 1].astype(np.float32) - 128.0) / 128.0
    quats = _three_components(rotations) if version == 2 else _smallest_three(rotations)
    logs = scales / _SCALE_STEP + _SMALLEST_LOG
    ids, blur = np.zeros(count, np.int64), EPS_2D if flags & _ANTIALIASED else USUAL_EPS_2D
    read = Splats(means, quats, np.exp(logs), alphas[:, 0] / 255.0, sh, ids, blur=blur)
    splats, warnings = cleaned(path, read)
    return splats, warnings + degree_warnings(path, degree)


def _unpack(path: Path) -> tuple[int, int, int, int, int, bytes]:
    """Return the number of splats, degree, fractional bits, flags and version of an SPZ file, and its plain bytes."""
    try:
        packed = read_regular(path)
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); check the file.") from error
    if len(packed) >= 8 and struct.unpack_from("<II", packed)[0] == MAGIC:
        raise _other_version(path, struct.unpack_from("<II", packed)[1])
    stream = zlib.decompressobj(zlib.MAX_WBITS | 16)
    try:
        head = stream.decompress(packed, _HEADER.size)
        if len(head) < _HEADER.size or _HEADER.unpack(head)[0] != MAGIC:
            raise InputError(f"{path} is not an SPZ file; export it again as SPZ or PLY.")
        _, version, count, degree, bits, flags, _ = _HEADER.unpack(head)
        if version not in _READABLE:
            raise _other_version(path, version)
        if degree > _HIGHEST_DEGREE or bits > _MOST_BITS:
            raise InputError(f"{path} has a damaged SPZ header; export it again.")
        if count > _MOST_SPLATS:
            raise InputError(f"{path} declares {count:,} splats, more than {_MOST_SPLATS:,}; export it as PLY.")
        size = count * (16 + (3 if version == 2 else 4) + 3 * ((degree + 1) ** 2 - 1))
        body = stream.decompress(stream.unconsumed_tail, size) if size else b""
    except zlib.error as error:
        raise InputError(f"{path} is damaged or not an SPZ file ({error}); export it again as SPZ or PLY.") from error
    if len(body) < size:
        raise InputError(f"{path} is truncated: it declares {count} splats but ends before them; export it again.")
    return count, degree, bits, flags, version, head + body


def _other_version(path: Path, version: int) -> InputError:
    return InputError(
        f"{path} is SPZ of version {version}, but only versions {_READABLE[0]} and {_READABLE[1]} are read; export "
        f"it as PLY, or convert it by `splat-transform {path.name} {path.stem}.ply` of PlayCanvas."
    )


def _three_components(packed: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return quaternions (N, 4) wxyz from bytes (N, 3) of x, y and z; w is not negative."""
    xyz = packed / 127.5 - 1.0
    w = np.sqrt(np.maximum(0.0, 1.0 - (xyz**2).sum(1)))
    return np.column_stack([w, xyz]).astype(np.float32)


def _smallest_three(packed: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return quaternions (N, 4) wxyz from bytes (N, 4), the inverse of `_rotations`."""
    values = np.ascontiguousarray(packed).view("<u4")[:, 0]
    largest = (values >> 30).astype(np.int64)
    xyzw = np.zeros((len(values), 4))
    for axis in (3, 2, 1, 0):
        stored = largest != axis
        size = (values & 511) / (np.sqrt(2.0) * 511.0)
        xyzw[stored, axis] = np.where(values & 512, -size, size)[stored]
        values = np.where(stored, values >> 10, values)
    rows = np.arange(len(values))
    xyzw[rows, largest] = np.sqrt(np.maximum(0.0, 1.0 - (xyzw**2).sum(1)))
    return xyzw[:, [3, 0, 1, 2]].astype(np.float32)
