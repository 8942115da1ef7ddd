"""anchors.ply: the anchors of a model, for inspection of its structure.

Properties: x, y, z in the capture's coordinates; object_id; scale_0 .. 2, the scales of the offsets in world units, not
their logarithms; opacity, the mean over the anchor's splats, 0 if it has none; splats, their number.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError
from .ply import read_vertices, write_vertex_blocks

_AXES = ("x", "y", "z")
SCALES = ("scale_0", "scale_1", "scale_2")
_OTHERS = (("object_id", "u4"), *((name, "f4") for name in SCALES), ("opacity", "f4"), ("splats", "u4"))
PROPERTIES = (*_AXES, *(name for name, _ in _OTHERS))


@dataclass(frozen=True)
class AnchorTable:
    """A anchors of a model.

    Attributes:
        positions: (A, 3) in the capture's coordinates.
        ids: (A,) object IDs.
        scales: (A, 3) scales of the offsets, in world units.
        opacities: (A,) mean opacity of the splats.
        splats: (A,) number of splats.
    """

    positions: np.ndarray
    ids: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    splats: np.ndarray


def write_anchor_tables(path: Path, count: int, tables: Iterable[AnchorTable], position: str) -> None:
    """Write `count` anchors, given in several tables, as PLY, atomically; `position` is the type of x, y and z."""
    dtype = np.dtype([*((axis, position) for axis in _AXES), *_OTHERS])
    write_vertex_blocks(path, dtype, count, (_rows(table, dtype) for table in tables))


def _rows(anchors: AnchorTable, dtype: np.dtype) -> np.ndarray:
    """Return the records of a table of anchors."""
    rows = np.zeros(len(anchors.ids), dtype)
    for i in range(3):
        rows[_AXES[i]], rows[SCALES[i]] = anchors.positions[:, i], anchors.scales[:, i]
    rows["object_id"], rows["opacity"], rows["splats"] = anchors.ids, anchors.opacities, anchors.splats
    return rows


def read_anchor_table(path: Path) -> np.ndarray:
    """Read anchors as a structured array (A,) with at least `PROPERTIES`; values are not checked.

    Raises:
        InputError: The file is missing, truncated, ASCII, or lacks properties.
    """
    table = read_vertices(path)
    missing = [name for name in PROPERTIES if name not in (table.dtype.names or ())]
    if missing:
        raise InputError(f"{path} has no property {', '.join(missing)}; train again.")
    return table
