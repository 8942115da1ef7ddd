"""Filling of the holes of removed and moved objects for Blender, computed once for each state of the edits."""

from __future__ import annotations

from ...editing import apply_splat_edits, compute_fill
from ...export import read_splats, splat_table
from ...shared.formats.atomic import require_still_there
from ...shared.reconstruction.fill import FillRows, fill_path, read_fill, write_fill
from ...shared.reconstruction.folder import Reconstruction
from ...shared.reconstruction.objects import read_objects
from ...shared.stopping import StoppingReporter

FILL = "fill"
"""Name of the filling among the parts of a command."""


def fill_holes(folder: Reconstruction, reporter: StoppingReporter) -> dict[int, int]:
    """Fill the holes of removed and moved objects where their edits ask for it, in the file that `fill_path` names.

    Returns:
        The number of new splats for each object whose hole is to be filled.
    """
    if not folder.splats.is_file():
        return {}  # Edits may exist before splats.
    objects = read_objects(folder.objects)
    while (path := fill_path(folder, objects)) is not None and not path.is_file():
        reporter.begin(FILL, "Filling the holes of removed and moved objects")
        require_still_there(folder.folder)
        path.parent.mkdir(parents=True, exist_ok=True)
        splats = apply_splat_edits(read_splats(folder.splats)[0], folder)[0]
        if fill_path(folder, objects) != path:
            continue  # Splats were deleted in the meantime.
        fill = compute_fill(splats, objects, reporter)
        write_fill(path, FillRows(splat_table(fill.splats), fill.put, fill.fills))
    if path is None:
        return {}
    rows = read_fill(path)
    return {entry.id: rows.count_new(entry.id) for entry in objects if entry.fill}
