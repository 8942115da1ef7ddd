"""Filling of the holes of removed objects for Blender, computed once for each state of the edits."""

from __future__ import annotations

import numpy as np

from ...editing import Fill, compute_fill
from ...export import read_splats, splat_table
from ...shared.formats.ply import read_vertices, write_vertices
from ...shared.formats.splat_ply import UNOBSERVED
from ...shared.reconstruction.fill import FILLS, fill_path, forget_old
from ...shared.reconstruction.folder import Reconstruction
from ...shared.reconstruction.objects import read_objects
from ...shared.stopping import StoppingReporter


def fill_holes(folder: Reconstruction, reporter: StoppingReporter) -> dict[int, int]:
    """Fill the holes of removed objects where their edits ask for it, in the file that `fill_path` names.

    Returns:
        The number of new splats for each object whose hole is to be filled.
    """
    if not folder.splats.is_file():
        return {}  # Edits may exist before splats.
    objects = read_objects(folder.objects)
    path = fill_path(folder, objects)
    if path is None:
        return {}
    if not path.is_file():
        reporter.status("Filling the holes of removed objects")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_vertices(path, _table(compute_fill(read_splats(folder.splats)[0], objects)))
        forget_old(path)
    table = read_vertices(path)
    fills = table[FILLS][table[UNOBSERVED] != 0]
    return {entry.id: int((fills == entry.id).sum()) for entry in objects if entry.removed and entry.fill}


def _table(fill: Fill) -> np.ndarray:
    rows = splat_table(fill.splats)
    table = np.zeros(len(rows), [*rows.dtype.descr, (FILLS, "<u4")])
    for name in rows.dtype.names or ():
        table[name] = rows[name]
    table[UNOBSERVED], table[FILLS] = fill.put, fill.fills
    return table
