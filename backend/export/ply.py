"""Splats as the PLY file that 3D Gaussian splatting programs exchange, with one property more: `object_id`."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..fill_file import INVENTED
from ..model.splats import Splats
from ..ply import read_vertices, vertex_header
from ..protocol import InputError, atomic_file

OPACITY_MARGIN = 1e-7
"""Opacities are kept this far from 0 and 1, so that their logits are finite in float32."""

SMALLEST_SCALE = float(np.finfo(np.float32).tiny)
FLOAT32_RELATIVE_ERROR = 2.0**-24
ROWS_AT_ONCE = 1 << 16


def property_names(degree: int) -> list[str]:
    """The properties of a splat PLY of this spherical-harmonics degree, in the order of the file."""
    rest = 3 * ((degree + 1) ** 2 - 1)
    return [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{i}" for i in range(rest)),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "object_id"),
    ]


def write_splats(path: Path, splats: Splats, with_ids: bool = True) -> list[str]:
    """Write `splats` to `path` atomically; returns warnings about splats that could not be written.

    Binary little-endian, one float32 a property, `object_id` as uint32 at the end unless `with_ids` is False: some
    programs count on the other properties being all there are. After it, `invented` as uchar where any splat is.
    Opacity is stored as its logit,
    scales as logarithms, `f_rest` all red coefficients first, then green, then blue. Positions are float32, except
    where the splats lie so far from the origin that float32 would move them by more than 1e-6 of their extent: then
    double.
    Splats with NaN or Inf, or a zero quaternion, are left out.
    """
    path = Path(path)
    keep = _usable(splats.means, splats.quats, splats.scales, splats.opacities, splats.sh)
    warnings = []
    if not keep.all():
        warnings.append(
            f"{int((~keep).sum())} of {len(splats)} splats were not written to {path.name}: "
            "they hold NaN, Inf or a zero quaternion."
        )
        splats = splats.select(keep)
    if len(splats) and (splats.object_ids.min() < 0 or splats.object_ids.max() > 0xFFFFFFFF):
        raise ValueError("object IDs must be from 0 to 2^32 - 1")

    names = [name for name in property_names(splats.degree) if with_ids or name != "object_id"]
    if with_ids and splats.invented.any():
        names.append(INVENTED)
    dtype = _layout(splats, names)

    with atomic_file(path) as file:
        file.write(vertex_header(dtype, len(splats)))
        for start in range(0, len(splats), ROWS_AT_ONCE):
            file.write(_rows(splats, slice(start, start + ROWS_AT_ONCE), dtype).tobytes())
    return warnings


def splat_table(splats: Splats) -> NDArray:
    """All splats as `write_splats` writes them, with IDs and with `invented`, whether any is or not."""
    return _rows(splats, slice(None), _layout(splats, [*property_names(splats.degree), INVENTED]))


def _layout(splats: Splats, names: list[str]) -> np.dtype:
    """The records of a file that holds these properties of `splats`."""
    position = position_kind(splats)
    kinds = {"x": position, "y": position, "z": position, "object_id": "u4", INVENTED: "u1"}
    return np.dtype([(name, "<" + kinds.get(name, "f4")) for name in names])


def _rows(splats: Splats, rows: slice, dtype: np.dtype) -> NDArray:
    """The records of some rows, in the layout of the file."""
    means = splats.means[rows]
    table = np.zeros(len(means), dtype)
    for axis, name in enumerate("xyz"):
        table[name] = means[:, axis]
    sh = splats.sh[rows]
    for channel in range(3):
        table[f"f_dc_{channel}"] = sh[:, 0, channel]
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(len(means), 3 * (sh.shape[1] - 1))
    for i in range(rest.shape[1]):
        table[f"f_rest_{i}"] = rest[:, i]
    opacity = np.clip(splats.opacities[rows].astype(np.float64), OPACITY_MARGIN, 1.0 - OPACITY_MARGIN)
    table["opacity"] = np.log(opacity) - np.log1p(-opacity)
    scales = np.log(np.maximum(splats.scales[rows].astype(np.float64), SMALLEST_SCALE))
    for axis in range(3):
        table[f"scale_{axis}"] = scales[:, axis]
    quats = splats.quats[rows]
    for i in range(4):
        table[f"rot_{i}"] = quats[:, i]
    for name, values in (("object_id", splats.object_ids), (INVENTED, splats.invented)):
        if name in (dtype.names or ()):
            table[name] = values[rows]
    return table


def _usable(means: NDArray, quats: NDArray, scales: NDArray, opacities: NDArray, sh: NDArray) -> NDArray:
    """(N,) bool: everything finite and the quaternion not zero."""
    keep = np.isfinite(opacities)
    for values in (means, quats, scales, sh):
        keep &= np.isfinite(values.reshape(len(keep), math.prod(values.shape[1:]))).all(axis=1)
    keep &= np.abs(quats).max(axis=1, initial=0.0) > 1e-12
    return keep


def position_kind(splats: Splats) -> str:
    """`f8` where float32 positions would be off by more than 1e-6 of the extent of the splats, else `f4`."""
    if len(splats) == 0 or splats.means.dtype != np.float64:
        return "f4"
    extent = float(np.ptp(splats.means, axis=0).max() + splats.scales.max())
    return "f8" if float(np.abs(splats.means).max()) * FLOAT32_RELATIVE_ERROR > 1e-6 * extent else "f4"


def read_splats(path: Path) -> tuple[Splats, list[str]]:
    """Read a splat PLY of ours or of another program; returns the splats and warnings about what was dropped.

    Properties may come in any order and of any number type; unknown ones are skipped; without `object_id` every splat
    gets 0. Rows with NaN or Inf or a zero quaternion are dropped and counted in the warnings. Positions keep the
    file's precision; scales and opacities are float64, so that writing what was read gives the same file again.
    Raises InputError that names the file when it is missing, cut short, ASCII, or holds no splats.
    """
    path = Path(path)
    table = read_vertices(path)
    names = table.dtype.names or ()
    needed = [name for name in property_names(0) if name not in ("nx", "ny", "nz", "object_id")]
    missing = [name for name in needed if name not in names]
    if missing:
        raise InputError(
            f"{path} is a PLY file but not one of Gaussian splats: it has no property {', '.join(missing)}."
        )
    rest_count = sum(name.startswith("f_rest_") for name in names)
    coefficients = rest_count // 3 + 1
    if rest_count % 3 or math.isqrt(coefficients) ** 2 != coefficients:
        raise InputError(f"{path} has {rest_count} properties f_rest_*; 0, 9, 24 or 45 were expected.")
    rest_names = [f"f_rest_{i}" for i in range(rest_count)]
    if any(name not in names for name in rest_names):
        raise InputError(f"{path} has {rest_count} properties f_rest_*, but they are not numbered from 0.")

    n = len(table)
    means = _columns(table, ["x", "y", "z"])
    quats = _columns(table, [f"rot_{i}" for i in range(4)])
    scales = _columns(table, [f"scale_{i}" for i in range(3)]).astype(np.float64)
    opacities = table["opacity"].astype(np.float64)
    sh = np.empty((n, coefficients, 3), np.float32)
    for channel in range(3):
        sh[:, 0, channel] = table[f"f_dc_{channel}"]
        for k in range(1, coefficients):
            sh[:, k, channel] = table[rest_names[channel * (coefficients - 1) + k - 1]]
    warnings: list[str] = []
    if "object_id" in names:
        object_ids = _object_ids(table["object_id"], warnings)
    else:
        object_ids = np.zeros(n, np.int64)
    invented = table[INVENTED] != 0 if INVENTED in names else np.zeros(n, bool)

    keep = _usable(means, quats, scales, opacities, sh)
    keep &= (scales < math.log(np.finfo(np.float32).max)).all(axis=1)
    if not keep.all():
        warnings.append(
            f"{int((~keep).sum())} of {n} splats in {path.name} were dropped: they hold NaN, Inf or a zero quaternion."
        )
        means, quats, scales, opacities, sh = means[keep], quats[keep], scales[keep], opacities[keep], sh[keep]
        object_ids, invented = object_ids[keep], invented[keep]

    lengths = np.linalg.norm(quats.astype(np.float64), axis=1)
    off = np.abs(lengths - 1.0) > 1e-6
    quats[off] = quats[off] / lengths[off, None]
    scales = np.maximum(np.exp(np.maximum(scales, math.log(SMALLEST_SCALE))), SMALLEST_SCALE)
    opacities = np.clip(1.0 / (1.0 + np.exp(-np.clip(opacities, -80, 80))), OPACITY_MARGIN, 1.0 - OPACITY_MARGIN)
    return Splats(means, quats, scales, opacities, sh, object_ids, invented), warnings


def _columns(table: NDArray, names: list[str]) -> NDArray:
    """(N, len(names)) float64 where the file has double or 32-bit integers, else float32."""
    kind = np.result_type(np.float32, *(table.dtype[name] for name in names))
    out = np.empty((len(table), len(names)), kind)
    for i, name in enumerate(names):
        out[:, i] = table[name]
    return out


def _object_ids(column: NDArray, warnings: list[str]) -> NDArray:
    """IDs as int64; what is no ID (negative, too large, NaN) becomes 0 and is counted."""
    if column.dtype.kind == "f":
        values = column.astype(np.float64)
        good = np.isfinite(values) & (values >= 0) & (values <= 0xFFFFFFFF)
        ids = np.where(good, np.rint(np.where(good, values, 0)), 0).astype(np.int64)
    else:
        ids = column.astype(np.int64)
        good = ids >= 0
        ids = np.where(good, ids, 0)
    if not good.all():
        warnings.append(f"{int((~good).sum())} splats have an object_id that is no ID; they were given 0.")
    return ids
