"""splat-edits.ply: the user's edits of single splats, and the box that the scene is cropped to.

Each row is a splat of splats.ply that is deleted or assigned to another object. Its key (see
`backend/shared/splats/keys.py`) is in the properties `key_low` and `key_high`; `deleted` and `assigned` are 0 or 1, and
`object_id` is the object that it is assigned to. Keys change with the splats, so after further training these edits
match no splat; they remain in the file until the user clears them. The box is a comment in the header, `crop` and 16
numbers: the rows of a map (4, 4) from the cube of -1 to 1 to the capture's coordinates. Splats whose centers, as
captured, are outside are hidden. It does not depend on keys, so it is kept when training continues.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...class_table import LARGEST_ID
from ...errors import InputError
from ...formats.ply import read_comments, read_vertices, write_vertices
from ..folder import Reconstruction
from ..objects import Matrix, affine_map

_ROW = np.dtype([("key_low", "<u4"), ("key_high", "<u4"), ("deleted", "u1"), ("assigned", "u1"), ("object_id", "<u4")])
_CROP = "crop"
_HALF = np.uint64(32)


def _no_rows() -> NDArray:
    return np.zeros(0, _ROW)


@dataclass(frozen=True)
class Applied:
    """What edits do to N splats.

    Attributes:
        kept: (N,) bool; false for deleted and cropped splats.
        object_ids: (N,) int64 IDs after the edits.
        missing: number of the edits that match none of the splats.
    """

    kept: NDArray[np.bool_]
    object_ids: NDArray[np.int64]
    missing: int


@dataclass(frozen=True)
class SplatEdits:
    """Edits of single splats; methods return changed copies.

    Attributes:
        rows: (n,) records of the file, by ascending key.
        crop: map (4, 4) of the box that the scene is cropped to, or None.
    """

    rows: NDArray = field(default_factory=_no_rows)
    crop: Matrix | None = None

    def __bool__(self) -> bool:
        return bool(len(self.rows)) or self.crop is not None

    @property
    def keys(self) -> NDArray[np.uint64]:
        """Keys (n,) of the edited splats, ascending."""
        return _keys_of(self.rows)

    @property
    def deleted(self) -> int:
        """Number of deleted splats."""
        return int(np.count_nonzero(self.rows["deleted"]))

    @property
    def assigned(self) -> int:
        """Number of splats that are assigned to another object."""
        return int(np.count_nonzero(self.rows["assigned"]))

    def delete(self, keys: NDArray[np.uint64]) -> SplatEdits:
        """Delete the splats with these keys."""
        rows, mine = self._with(keys)
        rows["deleted"][mine] = 1
        return replace(self, rows=rows)

    def restore(self) -> SplatEdits:
        """Restore all deleted splats."""
        rows = self.rows.copy()
        rows["deleted"] = 0
        return replace(self, rows=rows[rows["assigned"] != 0])

    def assign(self, keys: NDArray[np.uint64], object_id: int) -> SplatEdits:
        """Assign the splats with these keys to an object; ID 0 is "no object"."""
        rows, mine = self._with(keys)
        rows["assigned"][mine], rows["object_id"][mine] = 1, object_id
        return replace(self, rows=rows)

    def apply(self, keys: NDArray[np.uint64], object_ids: NDArray, means: NDArray) -> Applied:
        """Apply the edits to splats.

        Args:
            keys: (N,) their keys.
            object_ids: (N,) their IDs.
            means: (N, 3) their positions in the capture's coordinates.

        Returns:
            Which splats are kept, their IDs, and the number of edits without a splat.
        """
        kept, ids = np.ones(len(keys), bool), np.array(object_ids, np.int64)
        known = self.keys
        missing = len(known)
        if len(known) and len(keys):
            place = np.minimum(np.searchsorted(known, keys), len(known) - 1)
            mine = np.flatnonzero(known[place] == keys)
            rows = self.rows[place[mine]]
            kept[mine] = rows["deleted"] == 0
            assigned = rows["assigned"] != 0
            ids[mine[assigned]] = rows["object_id"][assigned]
            missing -= len(np.unique(place[mine]))
        if self.crop is not None:
            kept &= inside_box(means, self.crop)
        return Applied(kept, ids, missing)

    def _with(self, keys: NDArray[np.uint64]) -> tuple[NDArray, NDArray[np.int64]]:
        """Return the rows with new ones for unknown keys, and the indices of the rows of `keys`."""
        together = np.union1d(self.keys, keys)
        rows = np.zeros(len(together), _ROW)
        rows["key_low"], rows["key_high"] = together & np.uint64(LARGEST_ID), together >> _HALF
        rows[np.searchsorted(together, self.keys)] = self.rows
        return rows, np.searchsorted(together, keys)


def inside_box(points: NDArray, box: ArrayLike) -> NDArray[np.bool_]:
    """Find the points (n, 3) in the box that an affine map (4, 4) makes of the cube of -1 to 1: (n,) bool."""
    back = np.linalg.inv(np.asarray(box, np.float64))
    local = np.asarray(points, np.float64) @ back[:3, :3].T + back[:3, 3]
    return np.abs(local).max(1, initial=0.0) <= 1.0


def read_splat_edits(folder: Reconstruction) -> SplatEdits:
    """Read the edits of single splats; without the file there are none.

    Raises:
        InputError: The file cannot be read, or is not one of splat edits.
    """
    path = folder.splat_edits
    if not path.exists():
        return SplatEdits()
    table = read_vertices(path)
    names = table.dtype.names or ()
    if any(name not in names or table.dtype[name].kind != "u" for name in _ROW.names or ()):
        raise _invalid(path, "it lacks a property of splat edits")
    rows = np.zeros(len(table), _ROW)
    for name in _ROW.names or ():
        if len(table) and table[name].max() > np.iinfo(_ROW[name]).max:
            raise _invalid(path, f"its property {name} is too large")
        rows[name] = table[name]
    _, first = np.unique(_keys_of(rows), return_index=True)
    if len(first) < len(rows):
        raise _invalid(path, "it has two edits of one splat")
    return SplatEdits(rows[first], _crop_of(path))


def write_splat_edits(folder: Reconstruction, edits: SplatEdits) -> None:
    """Write the edits of single splats, atomically; equal edits make equal files. Without edits, delete the file.

    Raises:
        OSError: The file cannot be written.
    """
    if not edits:
        folder.splat_edits.unlink(missing_ok=True)
        return
    comments = []
    if edits.crop is not None:
        comments = [" ".join([_CROP, *(repr(value) for row in edits.crop for value in row)])]
    write_vertices(folder.splat_edits, edits.rows, comments)


def digest_of(edits: SplatEdits) -> str:
    """Return a hash of the edits; the empty string if there are none."""
    return hashlib.sha256(edits.rows.tobytes() + repr(edits.crop).encode()).hexdigest()[:24] if edits else ""


def missing_sentence(missing: int, edits: SplatEdits, path: Path) -> str:
    """Return the warning about edits that match no splat."""
    return (
        f"{missing:,} of {len(edits.rows):,} edits of single splats in {path} match no splat, as after further "
        "training; they stay in the file until it is cleared or deleted."
    )


def _keys_of(rows: NDArray) -> NDArray[np.uint64]:
    return rows["key_high"].astype(np.uint64) << _HALF | rows["key_low"]


def _crop_of(path: Path) -> Matrix | None:
    found = None
    for comment in read_comments(path):
        word, *values = comment.split()[:18] or [""]
        if word != _CROP:
            continue
        try:
            found = affine_map(np.array([float(value) for value in values]).reshape(4, 4))
        except ValueError as error:
            raise _invalid(path, "its crop is not an invertible map of four rows") from error
    return found


def _invalid(path: Path, why: str) -> InputError:
    return InputError(f"{path} is not a file of splat edits ({why}); delete it, which drops these edits.")
