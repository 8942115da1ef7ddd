"""The anchors that the splats hang on, as PLY: what a program shows of the model's structure."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .. import device
from ..model.object_model import ObjectModel
from ..model.splats import Splats
from ..ply import write_vertices
from .ply import position_kind


def write_anchors(path: Path, model: ObjectModel, splats: Splats, source: np.ndarray) -> None:
    """Write the model's anchors to `path`, atomically.

    A row an anchor: x, y, z in the type that a file of `splats` has them in, object_id, scale_0 .. 2 (what it scales
    its offsets by), opacity (the mean of its splats', 0 without any) and splats (how many of `splats` are its), in the
    capture's coordinates. source (N,) int64: which offset each splat is, as anchor * offsets + offset.
    """
    anchors = model.anchors
    count = len(anchors)
    owner = source // anchors.layout.offsets
    numbers = np.bincount(owner, minlength=count)
    opacity = np.bincount(owner, splats.opacities, count) / np.maximum(numbers, 1)
    # No further than the model itself goes when it makes splats of them.
    logs = device.host(anchors.rows[:, anchors.layout.extent_columns][:, :3])
    extents = np.exp(np.minimum(logs.astype(np.float64), 20.0))
    kind = position_kind(splats)
    table = np.zeros(
        count,
        [
            *((axis, kind) for axis in "xyz"),
            ("object_id", "u4"),
            *((f"scale_{i}", "f4") for i in range(3)),
            *(("opacity", "f4"), ("splats", "u4")),
        ],
    )
    positions = model.normalization.to_world(device.host(anchors.positions))
    for i, axis in enumerate("xyz"):
        table[axis] = positions[:, i]
        table[f"scale_{i}"] = extents[:, i] / model.normalization.scale
    table["object_id"] = model.object_ids[device.host(anchors.ids)]
    table["opacity"], table["splats"] = opacity, numbers
    write_vertices(path, table)
