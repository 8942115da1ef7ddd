"""Export of the model's anchors as PLY, for inspection of its structure."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..model.object_model import ObjectModel
from ..model.splats import blocks
from ..raster import devices
from ..shared.formats.anchors_ply import AnchorTable, write_anchor_tables
from .model_splats import ModelSplats
from .ply import PositionRange, only_usable


def write_anchors(path: Path, model: ObjectModel, splats: ModelSplats) -> None:
    """Write the anchors of a model as PLY, atomically.

    Positions have the same type as in a PLY file of `splats`.

    Args:
        path: The file to write.
        model: The model with the anchors.
        splats: The splats of the model.
    """
    anchors = model.anchors
    count, k = len(anchors), anchors.layout.offsets
    numbers, opacities = np.zeros(count, np.int64), np.zeros(count)
    positions = PositionRange()
    for part, source in splats.parts():
        owner = source // k
        np.add.at(numbers, owner, 1)
        np.add.at(opacities, owner, part.opacities)
        positions.add(only_usable(part))
    opacities /= np.maximum(numbers, 1)

    def table(rows: slice) -> AnchorTable:
        # The same limit as in the model (LOG_EXTENT_MAX).
        logs = devices.host(anchors.rows[rows, anchors.layout.extent_columns][:, :3])
        extents = np.exp(np.minimum(logs.astype(np.float64), 20.0))
        return AnchorTable(
            model.normalization.to_world(devices.host(anchors.positions[rows])),
            model.classes.ids_of(devices.host(anchors.ids[rows])),
            extents / model.normalization.scale,
            opacities[rows],
            numbers[rows],
        )

    write_anchor_tables(path, count, map(table, blocks(count)), positions.kind)
