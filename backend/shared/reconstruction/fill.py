"""Fill of the holes that removed objects leave, as a PLY file in a reconstruction's cache, from `edit` for Blender.

Its rows are splats with the properties of splats.ply, `unobserved` as uchar (1: a new splat, 0: one of splats.ply that
gives way to new ones) and `fills` as uint32: the ID of the removed object whose hole it fills. Places and colors are as
they were captured, and IDs those of the surface that is continued. The file's name says which splats and edits it is
for, so that undoing an edit finds the file of before.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from ..errors import InputError
from .folder import Reconstruction
from .objects import SceneObject

UNOBSERVED, FILLS = "unobserved", "fills"

_FORMAT = 2
"""Version of how holes are filled: files of other versions are made anew."""
_KEPT = 8
"""The newest files that stay in a cache."""

_digests: dict[Path, tuple[tuple[int, int], str]] = {}


def fill_path(folder: Reconstruction, objects: Sequence[SceneObject]) -> Path | None:
    """The file for a folder's splats and these edits, whether it is there or not; None where no place is to be closed.

    Raises InputError where splats.ply cannot be read.
    """
    if not any(entry.removed and entry.fill for entry in objects) or not folder.splats.is_file():
        return None
    edits = [
        (entry.id, entry.merged_into, entry.left_out, entry.removed, entry.floaters, entry.fill)
        for entry in objects
        if entry.merged_into is not None or entry.left_out or entry.removed
    ]
    made_of = f"{_FORMAT} {_digest(folder.splats)} {edits}"
    return folder.cache / f"fill-{hashlib.sha256(made_of.encode()).hexdigest()[:24]}.ply"


def forget_old(newest: Path) -> None:
    """Remove the files beside `newest` that were written the longest ago; none is needed but to save time."""
    written = {path: path.stat().st_mtime_ns for path in newest.parent.glob("fill-*.ply")}
    for path in sorted(written.keys() - {newest}, key=lambda path: -written[path])[_KEPT - 1 :]:
        path.unlink(missing_ok=True)


def _digest(path: Path) -> str:
    """Of a file's content, which is read again only where it was written since."""
    try:
        state = path.stat()
        stamp = state.st_mtime_ns, state.st_size
        if _digests.get(path, (None, ""))[0] != stamp:
            with path.open("rb") as file:
                _digests[path] = stamp, hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror or error}).") from error
    return _digests[path][1]
