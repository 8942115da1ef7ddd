"""Export of the model's anchors as PLY, for inspection of its structure."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..model.object_model import ObjectModel
from ..model.splats import Splats
from ..raster import devices
from ..shared.formats.ply import write_vertices
from .ply import position_kind


def write_anchors(path: Path, model: ObjectModel, splats: Splats, source: np.ndarray) -> None:
    """Write the anchors of a model as PLY, atomically.

    The properties are x, y, z in the capture's coordinates, of the same type as in a PLY file of `splats`; object_id;
    scale_0 .. 2 (the scales of the offsets); opacity (the mean over the anchor's splats, 0 if it has none); and splats
    (their number).

    Args:
        path: The file to write.
        model: The model with the anchors.
        splats: The N splats of the model.
        source: (N,) int64, the offset that each splat was generated from: anchor * offsets + offset.
    """
    anchors = model.anchors
    count = len(anchors)
    owner = source // anchors.layout.offsets
    numbers = np.bincount(owner, minlength=count)
    opacity = np.bincount(owner, splats.opacities, count) / np.maximum(numbers, 1)
    # The same limit as in the model (LOG_EXTENT_MAX).
    logs = devices.host(anchors.rows[:, anchors.layout.extent_columns][:, :3])
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
    positions = model.normalization.to_world(devices.host(anchors.positions))
    for i, axis in enumerate("xyz"):
        table[axis] = positions[:, i]
        table[f"scale_{i}"] = extents[:, i] / model.normalization.scale
    table["object_id"] = model.classes.ids_of(devices.host(anchors.ids))
    table["opacity"], table["splats"] = opacity, numbers
    write_vertices(path, table)
