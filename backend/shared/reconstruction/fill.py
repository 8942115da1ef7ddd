"""Fills of the holes that objects leave: PLY files in the reconstruction's cache, from `edit` for Blender.

Each row is a splat with the properties of splats.ply and two more: `unobserved` as uchar (1: a new splat, 0: a splat of
splats.ply that new ones replace) and `fills` as uint32, the ID of the object whose hole it fills. Positions and
colors are as captured, and object IDs are those of the continued surface. The file name is a hash of the splats and the
edits, so undoing an edit finds the previous file again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..formats.ply import write_vertices
from ..formats.regular_file import open_regular
from ..formats.splat_ply import UNOBSERVED, read_splat_table
from .folder import Reconstruction
from .objects import SceneObject

FILLS = "fills"
"""Also the name of the attribute that has these IDs in Blender."""

_FORMAT = 2
"""Version of the fill algorithm; files of other versions are not reused."""
_KEPT = 8
"""Number of fill files kept in a cache, newest first."""

_digests: dict[Path, tuple[tuple[int, int], str]] = {}


@dataclass(frozen=True)
class FillRows:
    """The n splats of a fill file.

    Attributes:
        splats: (n,) rows with the properties of splats.ply.
        new: (n,) bool; true for unobserved splats, false for splats of splats.ply that these replace.
        fills: (n,) int64 IDs of the objects whose holes are filled.
    """

    splats: np.ndarray
    new: np.ndarray
    fills: np.ndarray

    def select(self, mask: np.ndarray) -> FillRows:
        """Return the splats selected by a boolean mask (n,)."""
        return FillRows(self.splats[mask], self.new[mask], self.fills[mask])

    def count_new(self, object_id: int) -> int:
        """Return the number of new splats that fill the hole of an object."""
        return int((self.new & (self.fills == object_id)).sum())


def write_fill(path: Path, rows: FillRows) -> None:
    """Write a fill file, atomically, and delete the oldest fill files beside it."""
    table = np.zeros(len(rows.splats), [*rows.splats.dtype.descr, (FILLS, "<u4")])
    for name in rows.splats.dtype.names or ():
        table[name] = rows.splats[name]
    table[UNOBSERVED], table[FILLS] = rows.new, rows.fills
    write_vertices(path, table)
    _forget_old(path)


def read_fill(path: Path) -> FillRows:
    """Read a fill file.

    Raises:
        InputError: The file is missing, truncated, or was not written by `write_fill`.
    """
    table = read_splat_table(path)
    if not {UNOBSERVED, FILLS} <= set(table.dtype.names or ()):
        raise InputError(f"{path} is not a file of splats that fill holes; delete it.")
    return FillRows(table, table[UNOBSERVED] != 0, table[FILLS].astype(np.int64))


def fill_path(folder: Reconstruction, objects: Sequence[SceneObject]) -> Path | None:
    """Return the path of the fill file for a folder's splats and edits.

    Args:
        folder: The reconstruction.
        objects: The objects with their edits.

    Returns:
        The path, whether or not the file exists; None if no hole is to be filled or splats.ply does not exist.

    Raises:
        InputError: splats.ply or splat-edits.ply cannot be read.
    """
    if not any(entry.fill for entry in objects) or not folder.splats.is_file():
        return None
    edits = [
        (entry.id, entry.merged_into, entry.left_out, entry.removed, entry.floaters, entry.fill)
        + ("cleaned",) * entry.cleaned
        for entry in objects
        if entry.merged_into is not None or entry.left_out or entry.removed or entry.fill or entry.cleaned
    ]
    made_of = f"{_FORMAT} {_digest(folder.splats)} {edits}"
    if folder.splat_edits.is_file():
        made_of += f" {_digest(folder.splat_edits)}"
    return folder.cache / f"fill-{hashlib.sha256(made_of.encode()).hexdigest()[:24]}.ply"


def _forget_old(newest: Path) -> None:
    """Delete the oldest fill files beside `newest`; deleted files can be computed again."""
    written = {path: path.stat().st_mtime_ns for path in newest.parent.glob("fill-*.ply")}
    for path in sorted(written.keys() - {newest}, key=lambda path: -written[path])[_KEPT - 1 :]:
        path.unlink(missing_ok=True)


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file, which is cached until the file's modification time or size changes."""
    try:
        state = path.stat()
        stamp = state.st_mtime_ns, state.st_size
        if _digests.get(path, (None, ""))[0] != stamp:
            with open_regular(path) as file:
                _digests[path] = stamp, hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror or error}).") from error
    return _digests[path][1]
