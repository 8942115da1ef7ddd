"""Export of the model's anchors as PLY, for inspection of its structure."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..model.object_model import ObjectModel
from ..model.splats import Splats
from ..raster import devices
from ..shared.formats.anchors_ply import AnchorTable, write_anchor_table
from .ply import position_kind


def write_anchors(path: Path, model: ObjectModel, splats: Splats, source: np.ndarray) -> None:
    """Write the anchors of a model as PLY, atomically.

    Positions have the same type as in a PLY file of `splats`.

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
    table = AnchorTable(
        model.normalization.to_world(devices.host(anchors.positions)),
        model.classes.ids_of(devices.host(anchors.ids)),
        extents / model.normalization.scale,
        opacity,
        numbers,
    )
    write_anchor_table(path, table, position_kind(splats))
