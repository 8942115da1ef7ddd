"""Export of splats as .splat for web viewers: 32 bytes per splat, one color, no object IDs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..model.splats import Splats
from ..shared.formats.atomic import write_atomic
from ..shared.splats.spherical_harmonics import C0

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def write_splat(path: Path, splats: Splats) -> list[str]:
    """Write splats as .splat, atomically, sorted from the largest and most opaque down, as viewers expect.

    Args:
        path: The file to write.
        splats: The splats.

    Returns:
        A warning if view-dependent colors are lost.
    """
    order = np.argsort(-splats.opacities * splats.scales.astype(np.float64).prod(1) ** (1 / 3), kind="stable")
    splats = splats.select(order)
    rows = np.zeros(len(splats), _ROW)
    rows["mean"], rows["scale"] = splats.means, splats.scales
    color = np.column_stack([0.5 + C0 * splats.sh[:, 0], splats.opacities])
    rows["rgba"] = np.clip(np.rint(color * 255.0), 0, 255)
    rows["quat"] = np.clip(np.rint(splats.quats * 128.0 + 128.0), 0, 255)
    write_atomic(path, rows.tobytes())
    if splats.degree:
        return [f"{path.name} stores one color for each splat; its change with the view direction is lost."]
    return []
