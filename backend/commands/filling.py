"""What closes the places of removed objects, worked out once for each state of the edits, for those who show it."""

from __future__ import annotations

import numpy as np

from ..editing import Fill, fill_of
from ..export import read_splats, splat_table
from ..fill_file import CLOSES, INVENTED, fill_path, forget_old
from ..objects import read_objects
from ..ply import read_vertices, write_vertices
from ..protocol import Reconstruction
from ..stopping import StoppingReporter


def close_places(folder: Reconstruction, reporter: StoppingReporter) -> dict[int, int]:
    """Leave the file that `fill_path` names, where the edits ask for one; returns how many splats are invented for each
    object whose place is to be closed."""
    if not folder.splats.is_file():
        return {}  # There may be edits before there are splats.
    objects = read_objects(folder.objects)
    path = fill_path(folder, objects)
    if path is None:
        return {}
    if not path.is_file():
        reporter.status("Closing what removed objects hid")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_vertices(path, _table(fill_of(read_splats(folder.splats)[0], objects)))
        forget_old(path)
    table = read_vertices(path)
    closes = table[CLOSES][table[INVENTED] != 0]
    return {entry.id: int((closes == entry.id).sum()) for entry in objects if entry.removed and entry.fill}


def _table(fill: Fill) -> np.ndarray:
    rows = splat_table(fill.splats)
    table = np.zeros(len(rows), [*rows.dtype.descr, (CLOSES, "<u4")])
    for name in rows.dtype.names or ():
        table[name] = rows[name]
    table[INVENTED], table[CLOSES] = fill.put, fill.closes
    return table
