"""Splats in the PLY format of 3D Gaussian splatting, with the additional property `object_id`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..model.object_model import DISC_THICKNESS
from ..model.splats import Splats, blocks, some_blocks
from ..shared.class_table import LARGEST_ID
from ..shared.formats.ply import write_vertex_blocks
from ..shared.formats.splat_ply import (
    MEANS,
    OBJECT_ID,
    OPACITY,
    QUATS,
    SCALES,
    SMALLEST_QUAT,
    UNOBSERVED,
    Description,
    blur_comment,
    coefficients_of,
    description_comments,
    property_names,
    read_blur,
    read_splat_table,
    sh_names,
    splat_dtype,
    unobserved_of,
)
from ..shared.splats.blending import EPS_2D

OPACITY_MARGIN = 1e-7
"""Smallest distance of opacities from 0 and 1, so that their logits are finite in float32."""

SMALLEST_SCALE = float(np.finfo(np.float32).tiny)
FLOAT32_RELATIVE_ERROR = 2.0**-24
DEGREE_KEPT = 3
"""Highest degree of spherical harmonics that is read; higher ones are cut off."""


def write_splats(
    path: Path, splats: Splats, with_ids: bool = True, description: Description | None = None
) -> list[str]:
    """Write splats as PLY, atomically.

    The layout is that of `shared/formats/splat_ply.py`. Positions are double if float32 would change them by more than
    1e-6 of the splats' extent.

    Args:
        path: The file to write.
        splats: The splats. Those with NaN, Inf or a zero quaternion are left out.
        with_ids: Whether to write `object_id` and `unobserved`, which some programs do not accept.
        description: What comments in the header tell about the splats.

    Returns:
        Warnings about splats that were left out.

    Raises:
        ValueError: An object ID is not in 0 .. 2^32 - 1.
    """
    parts = [splats.select(rows) for rows in some_blocks(len(splats))]
    return write_splat_parts(path, lambda: parts, with_ids, description)[1]


def write_splat_parts(
    path: Path,
    make: Callable[[], Iterable[Splats]],
    with_ids: bool = True,
    description: Description | None = None,
) -> tuple[int, list[str]]:
    """Write splats as PLY, as `write_splats`, without having all of them in memory.

    Args:
        path, with_ids, description: As for `write_splats`.
        make: Returns the splats in parts, at least one, the same each time; called twice. All have the same degree.

    Returns:
        The number of splats in the file, and warnings about those that were left out.

    Raises:
        ValueError: As from `write_splats`.
    """
    path, total, count, degree, blur, some_unobserved = Path(path), 0, 0, 0, EPS_2D, False
    positions = PositionRange()
    for part in make():
        total, degree, blur = total + len(part), part.degree, part.blur
        part = only_usable(part)
        if len(part) and (part.object_ids.min() < 0 or part.object_ids.max() > LARGEST_ID):
            raise ValueError("object IDs must be from 0 to 2^32 - 1")
        positions.add(part)
        count += len(part)
        some_unobserved |= bool(part.unobserved.any())
    warnings = []
    if count < total:
        warnings.append(
            f"{total - count} of {total} splats were not written to {path.name}: "
            "they hold NaN, Inf or a zero quaternion."
        )
    names = [name for name in property_names(degree) if with_ids or name != OBJECT_ID]
    if with_ids and some_unobserved:
        names.append(UNOBSERVED)
    dtype = splat_dtype(names, positions.kind)
    comments = [blur_comment(blur), *description_comments(description or Description())]
    write_vertex_blocks(path, dtype, count, (_rows(only_usable(part), dtype) for part in make()), comments)
    return count, warnings


def splat_table(splats: Splats) -> NDArray:
    """Return all splats as the records of `write_splats`, always with IDs and `unobserved`."""
    positions = PositionRange()
    positions.add(splats)
    return _rows(splats, splat_dtype([*property_names(splats.degree), UNOBSERVED], positions.kind))


def _rows(splats: Splats, dtype: np.dtype) -> NDArray:
    """Return the records of splats."""
    table = np.zeros(len(splats), dtype)
    for axis, name in enumerate(MEANS):
        table[name] = splats.means[:, axis]
    for k, names in enumerate(sh_names(splats.sh.shape[1])):
        for channel, name in enumerate(names):
            table[name] = splats.sh[:, k, channel]
    opacity = np.clip(splats.opacities.astype(np.float64), OPACITY_MARGIN, 1.0 - OPACITY_MARGIN)
    table[OPACITY] = np.log(opacity) - np.log1p(-opacity)
    scales = np.log(np.maximum(splats.scales.astype(np.float64), SMALLEST_SCALE))
    for axis, name in enumerate(SCALES):
        table[name] = scales[:, axis]
    for i, name in enumerate(QUATS):
        table[name] = splats.quats[:, i]
    for name, values in ((OBJECT_ID, splats.object_ids), (UNOBSERVED, splats.unobserved)):
        if name in (dtype.names or ()):
            table[name] = values
    return table


def only_usable(splats: Splats) -> Splats:
    """Return the splats that `write_splats` does not leave out."""
    keep = _usable(splats.means, splats.quats, splats.scales, splats.opacities, splats.sh)
    return splats if keep.all() else splats.select(keep)


def _usable(means: NDArray, quats: NDArray, scales: NDArray, opacities: NDArray, sh: NDArray) -> NDArray:
    """Find the splats with finite values and a nonzero quaternion, (N,) bool."""
    keep = np.isfinite(opacities)
    for rows in blocks(len(keep)):
        for values in (means[rows], quats[rows], scales[rows], sh[rows]):
            keep[rows] &= np.isfinite(values.reshape(len(values), math.prod(values.shape[1:]))).all(axis=1)
        keep[rows] &= np.abs(quats[rows]).max(axis=1, initial=0.0) > SMALLEST_QUAT
    return keep


class PositionRange:
    """The range of splats, which are added in parts; from it follows the type of x, y and z in files."""

    def __init__(self) -> None:
        self._low, self._high, self._scale = np.full(3, np.inf), np.full(3, -np.inf), 0.0
        self._double = False

    def add(self, splats: Splats) -> None:
        """Extend the range by that of splats."""
        if len(splats):
            self._double |= splats.means.dtype == np.float64
            self._low = np.minimum(self._low, splats.means.min(0))
            self._high = np.maximum(self._high, splats.means.max(0))
            self._scale = max(self._scale, float(splats.scales.max()))

    @property
    def kind(self) -> str:
        """`f8` if float32 would change positions by more than 1e-6 of the splats' extent, otherwise `f4`."""
        if not self._double:
            return "f4"
        extent = float((self._high - self._low).max()) + self._scale
        largest = float(np.maximum(-self._low, self._high).max())
        return "f8" if largest * FLOAT32_RELATIVE_ERROR > 1e-6 * extent else "f4"


def rounding_warnings(path: Path, splats: Splats, step: float, advice: str | None = None) -> list[str]:
    """Return a warning if a file whose positions are multiples of `step` cannot hold those of splats.

    advice: the end of the sentence; None: that for splats far from the origin.
    """
    if len(splats) == 0 or step <= float(np.median(splats.scales.max(1))):
        return []
    far = ", since some are far from the origin; hide floaters, export in Blender's coordinates, or as PLY."
    return [
        f"{path.name} rounds positions to {step:.2g} units, which is more than the size of the splats{advice or far}"
    ]


def read_splats(path: Path) -> tuple[Splats, list[str]]:
    """Read a PLY file of splats, written by this or another program.

    Properties may have any order and number type; unknown ones are ignored. Without `object_id`, all IDs are 0, and
    without `scale_2`, splats are discs. Of spherical harmonics, degree 3 is kept at most. Positions keep the precision
    of the file; scales and opacities are float64, so that writing the splats again produces the same file.

    Args:
        path: The file to read.

    Returns:
        The splats, except those with NaN, Inf or a zero quaternion, and warnings about these and about what is lost.

    Raises:
        InputError: The file is missing, truncated, ASCII, or not a PLY of splats.
    """
    path = Path(path)
    table = read_splat_table(path, foreign=True)
    n = len(table)
    means = _columns(table, MEANS)
    quats = _columns(table, QUATS)
    scales = _log_scales(table)
    opacities = table[OPACITY].astype(np.float64)
    coefficients = coefficients_of(table)
    sh = np.empty((n, min(coefficients, (DEGREE_KEPT + 1) ** 2), 3), np.float32)
    for k, names in enumerate(sh_names(coefficients)[: sh.shape[1]]):
        for channel, name in enumerate(names):
            sh[:, k, channel] = table[name]
    warnings = degree_warnings(path, math.isqrt(coefficients) - 1)
    has_ids = OBJECT_ID in (table.dtype.names or ())
    object_ids = _object_ids(table[OBJECT_ID], warnings) if has_ids else np.zeros(n, np.int64)
    unobserved = unobserved_of(table)

    # Opaque, invisible and flat splats of other programs may have infinite logits and logarithms.
    opacities, scales = np.clip(opacities, -80, 80), np.maximum(scales, math.log(SMALLEST_SCALE))
    keep = _usable(means, quats, scales, opacities, sh)
    with np.errstate(over="ignore"):
        scales = np.exp(scales)
    opacities = 1.0 / (1.0 + np.exp(-opacities))
    read = Splats(means, quats, scales, opacities, sh, object_ids, unobserved, read_blur(path))
    splats, dropped = cleaned(path, read, keep)
    return splats, warnings + dropped


def cleaned(path: Path, splats: Splats, keep: NDArray | None = None) -> tuple[Splats, list[str]]:
    """Drop splats of a file that cannot be used, and bring the others into the limits of `Splats`.

    Args:
        path: The file, for the warning.
        splats: The splats, with any values; changed in place.
        keep: (N,) bool, which splats to keep if they can be used; all if not given.

    Returns:
        The splats that are finite, with unit quaternions, and a warning about the others.
    """
    usable = _usable(splats.means, splats.quats, splats.scales, splats.opacities, splats.sh)
    usable &= (splats.scales < np.finfo(np.float32).max).all(axis=1)
    keep = usable if keep is None else usable & keep
    warnings = []
    if not keep.all():
        warnings.append(
            f"{int((~keep).sum())} of {len(keep)} splats in {path.name} were dropped: they hold NaN, Inf or a zero "
            "quaternion."
        )
        splats = splats.select(keep)
    quats = splats.quats
    lengths = np.linalg.norm(quats.astype(np.float64), axis=1)
    off = np.abs(lengths - 1.0) > 1e-6
    quats[off] = quats[off] / lengths[off, None]
    splats.scales = np.maximum(splats.scales, SMALLEST_SCALE)
    splats.opacities = np.clip(splats.opacities, OPACITY_MARGIN, 1.0 - OPACITY_MARGIN)
    return splats, warnings


def degree_warnings(path: Path, degree: int) -> list[str]:
    """Return a warning if a file has spherical harmonics of a higher degree than is kept."""
    if degree <= DEGREE_KEPT:
        return []
    return [f"{path.name} has spherical harmonics of degree {degree}, of which {DEGREE_KEPT} are kept."]


def _log_scales(table: NDArray) -> NDArray[np.float64]:
    """Return the logarithms of the scales (N, 3), the third of which a file of discs does not have."""
    if SCALES[2] in (table.dtype.names or ()):
        return _columns(table, SCALES).astype(np.float64)
    wide = _columns(table, SCALES[:2]).astype(np.float64)
    return np.column_stack([wide, wide.min(1) + math.log(DISC_THICKNESS)])


def _columns(table: NDArray, names: tuple[str, ...]) -> NDArray:
    """Return columns (N, len(names)), float64 if the file has doubles or 32-bit integers, otherwise float32."""
    kind = np.result_type(np.float32, *(table.dtype[name] for name in names))
    out = np.empty((len(table), len(names)), kind)
    for i, name in enumerate(names):
        out[:, i] = table[name]
    return out


def _object_ids(column: NDArray, warnings: list[str]) -> NDArray:
    """Return object IDs as int64; invalid values (negative, too large, NaN) become 0, with a warning."""
    if column.dtype.kind == "f":
        values = column.astype(np.float64)
        good = np.isfinite(values) & (values >= 0) & (values <= LARGEST_ID)
        ids = np.where(good, np.rint(np.where(good, values, 0)), 0).astype(np.int64)
    else:
        ids = column.astype(np.int64)
        good = ids >= 0
        ids = np.where(good, ids, 0)
    if not good.all():
        warnings.append(f"{int((~good).sum())} splats have an invalid object_id; it was set to 0.")
    return ids
