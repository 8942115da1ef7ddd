# SPDX-License-Identifier: GPL-3.0-or-later
"""Writers for the files of a capture: PNG, PLY and COLMAP's binary model."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

PINHOLE = 1  # COLMAP's ID of the camera model.


def write_png(path: Path, pixels: np.ndarray) -> None:
    """Write (H, W) uint8 or uint16 grayscale or (H, W, 3) uint8 RGB pixels as PNG; the output is deterministic."""
    height, width = pixels.shape[:2]
    color = 2 if pixels.ndim == 3 else 0
    if color == 2 and (pixels.shape[2] != 3 or pixels.dtype != np.uint8):
        raise ValueError("RGB images must be uint8 with 3 channels")
    depth = {np.dtype(np.uint8): 8, np.dtype(np.uint16): 16}[pixels.dtype]
    big_endian = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder(">")))
    rows = big_endian.view(np.uint8).reshape(height, -1)
    lines = np.zeros((height, rows.shape[1] + 1), np.uint8)
    if color == 2:  # Filter 2 ("up") halves the size of images; ID maps compress better unfiltered.
        lines[:, 0] = 2
        lines[0, 1:] = rows[0]
        lines[1:, 1:] = rows[1:] - rows[:-1]
    else:
        lines[:, 1:] = rows

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0)
    chunks = [chunk(b"IHDR", header)]
    if color == 2:
        chunks.append(chunk(b"sRGB", b"\0"))
    chunks += [chunk(b"IDAT", zlib.compress(lines.tobytes(), 6)), chunk(b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))


def write_ply(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> None:
    """Write a triangle mesh as binary PLY: `vertices` (V, 3) in meters, `triangles` (F, 3) indices."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(triangles), np.dtype([("n", "u1"), ("v", "<i4", 3)]))
    faces["n"] = 3
    faces["v"] = triangles
    path.write_bytes(header.encode() + np.ascontiguousarray(vertices, "<f4").tobytes() + faces.tobytes())


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternion (w, x, y, z), w >= 0, of a (3, 3) rotation matrix."""
    m = rotation
    k = np.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], 0, 0, 0],
            [m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], 0, 0],
            [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1], 0],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m[0, 0] + m[1, 1] + m[2, 2]],
        ]
    )
    _, vectors = np.linalg.eigh(k / 3.0)
    x, y, z, w = vectors[:, -1]
    q = np.array([w, x, y, z])
    return q if q[0] >= 0 else -q


def write_colmap(
    folder: Path,
    intrinsics: Any,
    size: Any,
    names: Any,
    rotations: Any,
    translations: Any,
    observations: Any,
    points: Any,
) -> None:
    """Write cameras.bin, images.bin and points3D.bin for one PINHOLE camera.

    IDs count from 1 in the given order.

    Args:
        folder: output folder, created if missing.
        intrinsics: (fx, fy, cx, cy) in pixels.
        size: (width, height) in pixels.
        names: image names of the V views.
        rotations: (V, 3, 3) world to camera.
        translations: (V, 3) world to camera.
        observations: for each view (xy (K, 2) in pixels, point IDs (K,) with -1 for unmatched).
        points: dict of arrays `xyz` (P, 3), `rgb` (P, 3) uint8, `error` (P,) in pixels, and `track`, a list of (L, 2)
            arrays of (image ID, index in image).
    """
    folder.mkdir(parents=True, exist_ok=True)
    camera = struct.pack("<QiiQQ4d", 1, 1, PINHOLE, size[0], size[1], *intrinsics)
    (folder / "cameras.bin").write_bytes(camera)

    parts = [struct.pack("<Q", len(names))]
    for i, name in enumerate(names):
        xy, ids = observations[i]
        parts.append(struct.pack("<i7di", i + 1, *quaternion(rotations[i]), *translations[i], 1))
        parts.append(name.encode() + b"\0" + struct.pack("<Q", len(xy)))
        table = np.empty(len(xy), np.dtype([("xy", "<f8", 2), ("id", "<i8")]))
        table["xy"] = xy
        table["id"] = ids
        parts.append(table.tobytes())
    (folder / "images.bin").write_bytes(b"".join(parts))

    parts = [struct.pack("<Q", len(points["xyz"]))]
    for i, track in enumerate(points["track"]):
        values = (*points["xyz"][i], *points["rgb"][i], points["error"][i])
        parts.append(struct.pack("<Q3d3BdQ", i + 1, *values, len(track)))
        parts.append(np.ascontiguousarray(track, "<i4").tobytes())
    (folder / "points3D.bin").write_bytes(b"".join(parts))
