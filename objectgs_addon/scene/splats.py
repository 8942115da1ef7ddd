# SPDX-License-Identifier: GPL-3.0-or-later
"""Readers for splats.ply and anchors.ply, and their conversion to attributes of mesh carriers."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from ...backend.shared.errors import InputError
from ...backend.shared.formats.ply import read_vertices
from ...backend.shared.reconstruction.folder import Reconstruction
from .carrier import stored_ids

_NEEDED = (
    "x",
    "y",
    "z",
    "f_dc_0",
    "f_dc_1",
    "f_dc_2",
    "opacity",
    "scale_0",
    "scale_1",
    "scale_2",
    "rot_0",
    "rot_1",
    "rot_2",
    "rot_3",
)
LARGEST_LOG_SCALE = 80.0
ROWS_AT_ONCE = 1 << 14
"""Number of rows checked at a time, small enough to stay in the CPU cache."""

LARGEST_TABLE = 1 << 22
"""IDs below this limit are grouped by counting instead of sorting."""


def read_splats(folder: Path) -> tuple[np.ndarray, list[str]]:
    """Return splats.ply as a structured array, and warnings; splats that cannot be shown are left out.

    Raises:
        InputError: splats.ply is missing or lacks required properties.
    """
    path = Reconstruction(folder).splats
    if not path.is_file():
        raise InputError(f"{folder} has no splats.ply; train first.")
    table = read_vertices(path)
    names = table.dtype.names
    missing = [name for name in _NEEDED if name not in names]
    if missing:
        raise InputError(f"{path} is not a file of Gaussian splats: it lacks {', '.join(missing)}.")
    _rest_count(names, path)
    return _without_unusable(table, _NEEDED, path.name, "splats")


def read_anchors(folder: Path) -> tuple[np.ndarray | None, list[str]]:
    """Return anchors.ply as a structured array (None if there is no such file), and warnings.

    Raises:
        InputError: anchors.ply lacks required properties.
    """
    path = Reconstruction(folder).anchors
    if not path.is_file():
        return None, []
    table = read_vertices(path)
    needed = ("x", "y", "z", "object_id", "scale_0", "scale_1", "scale_2", "opacity", "splats")
    missing = [name for name in needed if name not in table.dtype.names]
    if missing:
        raise InputError(f"{path} has no property {', '.join(missing)}; train again.")
    return _without_unusable(table, needed, path.name, "anchors")


def ids_of(table: np.ndarray) -> np.ndarray:
    """Return the (n,) int64 object IDs of a table, 0 if it stores none."""
    if "object_id" not in (table.dtype.names or ()):
        return np.zeros(len(table), np.int64)
    ids = table["object_id"]
    if ids.dtype.kind == "f":
        ids = np.rint(np.nan_to_num(ids, nan=0.0))
    return np.clip(ids.astype(np.int64), 0, 0xFFFFFFFF)


def unique_ids(ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unique IDs in ascending order and the index of each of the (n,) `ids` among them.

    IDs below LARGEST_TABLE need no sort.
    """
    if len(ids) == 0 or ids.max() >= LARGEST_TABLE:
        unique, inverse = np.unique(ids, return_inverse=True)
        return unique, inverse.reshape(-1)
    counts = np.bincount(ids)
    return np.flatnonzero(counts), (np.cumsum(counts > 0) - 1)[ids]


def median_scale(table: np.ndarray) -> float:
    """Return the median, over a sample of splats, of each splat's middle scale; 1 if there are no splats."""
    if len(table) == 0:
        return 1.0
    some = table[:: max(1, len(table) // 10_000)]
    return float(np.exp(np.median(np.median(_columns(some, "scale_0", "scale_1", "scale_2"), axis=1))))


def splat_attributes(table: np.ndarray) -> dict[str, tuple[str, np.ndarray]]:
    """Return carrier attributes in the layout of Blender's own Gaussian splats, plus the object ID.

    Scales and opacities are linear, quats are unit length. `radiance:base` holds the raw degree 0 SH coefficients and
    the opacity; `radiance:sh_1` and following hold the higher coefficients, one RGB vector each.
    """
    rest = _rest_count(table.dtype.names) // 3
    base = _columns(table, "f_dc_0", "f_dc_1", "f_dc_2", "opacity")
    base[:, 3] = 1.0 / (1.0 + np.exp(-np.clip(base[:, 3], -80.0, 80.0)))
    rotation = _columns(table, "rot_0", "rot_1", "rot_2", "rot_3")
    rotation /= np.sqrt(np.einsum("ij,ij->i", rotation, rotation))[:, None]
    attributes = {
        "radiance:base": ("FLOAT_COLOR", base),
        "scale": ("FLOAT_VECTOR", np.exp(_columns(table, "scale_0", "scale_1", "scale_2"))),
        "rotation": ("QUATERNION", rotation),
        "object_id": ("INT", stored_ids(ids_of(table))),
    }
    for k in range(rest):
        names = (f"f_rest_{channel * rest + k}" for channel in range(3))
        attributes[f"radiance:sh_{k + 1}"] = ("FLOAT_VECTOR", _columns(table, *names))
    return attributes


def anchor_attributes(table: np.ndarray) -> dict[str, tuple[str, np.ndarray]]:
    """Return the carrier attributes of anchors: object ID, scale of the offsets, mean opacity and number of splats."""
    return {
        "object_id": ("INT", stored_ids(ids_of(table))),
        "scale": ("FLOAT_VECTOR", _columns(table, "scale_0", "scale_1", "scale_2")),
        "opacity": ("FLOAT", table["opacity"]),
        "splats": ("INT", table["splats"].astype(np.int32)),
    }


def _columns(table: np.ndarray, *names: str) -> np.ndarray:
    """Return the named columns as (n, len(names)) float32."""
    values = np.empty((len(table), len(names)), np.float32)
    for i, name in enumerate(names):
        values[:, i] = table[name]
    return values


def _rest_count(names: Any, path: Path | None = None) -> int:
    """Count the properties f_rest_*; if `path` is given, raise InputError unless they form whole SH degrees."""
    count = sum(name.startswith("f_rest_") for name in names)
    if path is not None and (
        count % 3
        or math.isqrt(count // 3 + 1) ** 2 != count // 3 + 1
        or any(f"f_rest_{i}" not in names for i in range(count))
    ):
        raise InputError(f"{path} has {count} properties f_rest_*; expected 0, 9, 24 or 45, numbered from 0.")
    return count


def _without_unusable(table: np.ndarray, names: Any, file: str, what: str) -> tuple[np.ndarray, list[str]]:
    keep = np.empty(len(table), bool)
    for start in range(0, len(table), ROWS_AT_ONCE):
        rows = table[start : start + ROWS_AT_ONCE]
        good = np.isfinite(sum(rows[name].astype(np.float64) for name in names))
        if "rot_0" in names:
            good &= np.maximum.reduce([np.abs(rows[f"rot_{i}"]) for i in range(4)]) > 1e-12
            good &= np.maximum.reduce([rows[f"scale_{i}"] for i in range(3)]) < LARGEST_LOG_SCALE
        keep[start : start + ROWS_AT_ONCE] = good
    if keep.all():
        return table, []
    return table[keep], [
        f"{int((~keep).sum())} of {len(table)} {what} in {file} are left out: "
        "they have NaN, infinite or too large values, or no rotation."
    ]
