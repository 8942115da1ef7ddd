"""Export and import of splats as .splat, for web viewers: 32 bytes per splat, one color, no object IDs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..model.splats import Splats
from ..shared.errors import InputError
from ..shared.formats.atomic import write_atomic
from ..shared.formats.regular_file import read_regular
from ..shared.splats.blending import USUAL_EPS_2D
from ..shared.splats.spherical_harmonics import C0
from .ply import cleaned, rounding_warnings

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def write_splat(path: Path, splats: Splats) -> list[str]:
    """Write splats as .splat, atomically, sorted from the largest and most opaque down, as viewers expect.

    Args:
        path: The file to write.
        splats: The splats.

    Returns:
        Warnings if positions are rounded, and if view-dependent colors are lost.
    """
    order = np.argsort(-splats.opacities * splats.scales.astype(np.float64).prod(1) ** (1 / 3), kind="stable")
    splats = splats.select(order)
    rows = np.zeros(len(splats), _ROW)
    rows["mean"], rows["scale"] = splats.means, splats.scales
    color = np.column_stack([0.5 + C0 * splats.sh[:, 0], splats.opacities])
    rows["rgba"] = np.clip(np.rint(color * 255.0), 0, 255)
    rows["quat"] = np.clip(np.rint(splats.quats * 128.0 + 128.0), 0, 255)
    write_atomic(path, rows.tobytes())
    warnings = rounding_warnings(path, splats, float(np.spacing(np.float32(np.abs(splats.means).max(initial=0.0)))))
    if splats.degree:
        warnings.append(f"{path.name} stores one color for each splat; its change with the view direction is lost.")
    return warnings


def read_splat(path: Path) -> tuple[Splats, list[str]]:
    """Read splats from a .splat file, written by this or another program.

    Args:
        path: The file to read.

    Returns:
        The splats, without objects, except those with NaN, Inf or a zero quaternion, and warnings about these.

    Raises:
        InputError: The file cannot be read, or its size is not a multiple of 32 bytes.
    """
    try:
        data = read_regular(path)
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); check the file.") from error
    if len(data) % _ROW.itemsize:
        raise InputError(
            f"{path} is truncated or not a .splat file: its {len(data)} bytes are not a multiple of {_ROW.itemsize}; "
            "export it again."
        )
    rows = np.frombuffer(data, _ROW)
    color = rows["rgba"].astype(np.float64) / 255.0
    sh = ((color[:, :3] - 0.5) / C0).astype(np.float32)[:, None]
    quats = (rows["quat"].astype(np.float32) - 128.0) / 128.0
    ids = np.zeros(len(rows), np.int64)
    splats = Splats(
        rows["mean"].copy(), quats, rows["scale"].astype(np.float64), color[:, 3], sh, ids, blur=USUAL_EPS_2D
    )
    return cleaned(path, splats)
