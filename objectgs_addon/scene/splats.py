# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats and anchors of a reconstruction folder that can be shown, and their conversion to attributes of carriers."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np

from ...backend.shared.errors import InputError
from ...backend.shared.formats import anchors_ply
from ...backend.shared.formats.splat_ply import (
    MEANS,
    OPACITY,
    QUATS,
    REQUIRED,
    SCALES,
    coefficients_of,
    ids_of,
    read_splat_table,
    sh_names,
    shown_rows,
)
from ...backend.shared.reconstruction.folder import Reconstruction
from ...backend.shared.splats.blending import LEAST_EPS_2D, USUAL_EPS_2D
from .carrier import stored_ids
from .edits.single_splats import table_keys

BLUR = "objectgs_low_pass"
"""Custom property of the mesh of a carrier of splats: the variance of their low-pass filter."""

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
    return _without_unusable(read_splat_table(path), REQUIRED, path.name, "splats")


def blur_of(mesh: bpy.types.Mesh) -> float:
    """Return the variance in square pixels of the low-pass filter with which the splats of a carrier are drawn."""
    blur = mesh.get(BLUR)
    return blur if isinstance(blur, float) and LEAST_EPS_2D <= blur <= USUAL_EPS_2D else USUAL_EPS_2D


def splat_keys(folder: Path) -> np.ndarray:
    """Return the (N,) keys of all splats in splats.ply, in its order; raises as `read_splats`."""
    path = Reconstruction(folder).splats
    if not path.is_file():
        raise InputError(f"{folder} has no splats.ply; train first.")
    return table_keys(read_splat_table(path))


def read_anchors(folder: Path) -> tuple[np.ndarray | None, list[str]]:
    """Return anchors.ply as a structured array (None if there is no such file), and warnings.

    Raises:
        InputError: anchors.ply lacks required properties.
    """
    path = Reconstruction(folder).anchors
    if not path.is_file():
        return None, []
    table = anchors_ply.read_anchor_table(path)
    return _without_unusable(table, anchors_ply.PROPERTIES, path.name, "anchors")


def positions_of(table: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return the (n, 3) float64 positions of a table of splats or anchors in reconstruction coordinates."""
    return np.stack([table[axis].astype(np.float64) - origin[i] for i, axis in enumerate(MEANS)], axis=1)


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
    return float(np.exp(np.median(np.median(_columns(some, *SCALES), axis=1))))


def splat_attributes(table: np.ndarray) -> dict[str, tuple[str, np.ndarray]]:
    """Return carrier attributes in the layout of Blender's own Gaussian splats, plus the object ID.

    Scales and opacities are linear, quats are unit length. `radiance:base` holds the raw degree 0 SH coefficients and
    the opacity; `radiance:sh_1` and following hold the higher coefficients, one RGB vector each.
    """
    constant, *higher = sh_names(coefficients_of(table))
    base = _columns(table, *constant, OPACITY)
    base[:, 3] = 1.0 / (1.0 + np.exp(-np.clip(base[:, 3], -80.0, 80.0)))
    rotation = _columns(table, *QUATS)
    rotation /= np.sqrt(np.einsum("ij,ij->i", rotation, rotation))[:, None]
    attributes = {
        "radiance:base": ("FLOAT_COLOR", base),
        "scale": ("FLOAT_VECTOR", np.exp(_columns(table, *SCALES))),
        "rotation": ("QUATERNION", rotation),
        "object_id": ("INT", stored_ids(ids_of(table))),
    }
    for k, names in enumerate(higher, 1):
        attributes[f"radiance:sh_{k}"] = ("FLOAT_VECTOR", _columns(table, *names))
    return attributes


def anchor_attributes(table: np.ndarray) -> dict[str, tuple[str, np.ndarray]]:
    """Return the carrier attributes of anchors: object ID, scale of the offsets, mean opacity and number of splats."""
    return {
        "object_id": ("INT", stored_ids(ids_of(table))),
        "scale": ("FLOAT_VECTOR", _columns(table, *anchors_ply.SCALES)),
        "opacity": ("FLOAT", table["opacity"]),
        "splats": ("INT", table["splats"].astype(np.int32)),
    }


def _columns(table: np.ndarray, *names: str) -> np.ndarray:
    """Return the named columns as (n, len(names)) float32."""
    values = np.empty((len(table), len(names)), np.float32)
    for i, name in enumerate(names):
        values[:, i] = table[name]
    return values


def _without_unusable(table: np.ndarray, names: tuple[str, ...], file: str, what: str) -> tuple[np.ndarray, list[str]]:
    keep = shown_rows(table, names)
    if keep.all():
        return table, []
    return table[keep], [
        f"{int((~keep).sum())} of {len(table)} {what} in {file} are left out: "
        "they have NaN, infinite or too large values, or no rotation."
    ]
