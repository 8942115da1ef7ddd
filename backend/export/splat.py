"""Splats as .splat, which web viewers read: 32 bytes a splat, one colour each, without object IDs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..model.splats import Splats
from ..protocol import write_atomic
from ..spherical_harmonics import C0

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def write_splat(path: Path, splats: Splats) -> list[str]:
    """Write `splats` to `path` atomically, the largest and most opaque first, as viewers load them; returns warnings:
    how colours change with direction is lost."""
    order = np.argsort(-splats.opacities * splats.scales.astype(np.float64).prod(1) ** (1 / 3), kind="stable")
    splats = splats.select(order)
    rows = np.zeros(len(splats), _ROW)
    rows["mean"], rows["scale"] = splats.means, splats.scales
    colour = np.column_stack([0.5 + C0 * splats.sh[:, 0], splats.opacities])
    rows["rgba"] = np.clip(np.rint(colour * 255.0), 0, 255)
    rows["quat"] = np.clip(np.rint(splats.quats * 128.0 + 128.0), 0, 255)
    write_atomic(path, rows.tobytes())
    if splats.degree:
        return [f"{path.name} holds one colour a splat; how it changes with direction is lost."]
    return []
