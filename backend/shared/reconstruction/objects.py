"""objects.json: the objects of a reconstruction as found by the vote, and the user's edits.

    {"objects": [{"id": 1, "name": "mug", "color": [59, 125, 216], "points": 812}, ...],
     "edits": {"1": {"name": "cup", "color": [255, 0, 0], "merged_into": 2, "left_out": true},
               "4": {"removed": true, "floaters": true, "fill": true},
               "5": {"recolor": {"hue": 0.3}, "transform": [[1, 0, 0, 2], ...], "copies": [[[1, 0, 0, 5], ...]]},
               "6": {"cleaned": true}, "7": {"separated": true, "name": "handle", "color": [0, 99, 0]}, ...}}

A new vote replaces "objects" and keeps "edits". An object with "separated" is in "edits" alone: the user has made it of
single splats of other objects. If a vote finds an object of its ID, it is another one, and gets none of its edits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..class_table import LARGEST_ID
from ..color.recolor import Recolor
from ..errors import InputError
from ..formats.json_file import read_json, write_json
from .lock import FolderInUse, locked

EDITABLE = (
    "name", "color", "merged_into", "left_out", "removed", "floaters", "fill", "cleaned", "recolor", "transform",
    "copies", "separated",
)  # fmt: skip

_LOCK = ".objects.lock"
_PATIENCE = 20.0
"""Seconds to wait for other changes of objects.json, each of which takes milliseconds."""

_FORMER_NAMES = {"colour": "color", "recolour": "recolor"}
"""Names of fields in files of older versions, and their present names."""

Matrix = tuple[tuple[float, float, float, float], ...]
"""The four rows of an affine map (4, 4) in the capture's coordinates, applied to an object as captured."""


@dataclass(frozen=True)
class SceneObject:
    """An object with the user's edits.

    For an object that is merged into another, only the name takes effect; the other object's edits apply to both.

    Attributes:
        id: object ID in the masks.
        name: display name.
        color: display color, sRGB 0 .. 255.
        points: number of points that the vote assigned to the object.
        merged_into: ID of the object that it is shown and meshed with, or None.
        left_out: exclude it from the reconstruction.
        removed: hide the reconstructed object and its duplicates.
        floaters: if removed, also hide unlabeled splats inside its convex hull.
        fill: fill the hole that it leaves in the ground or wall where it was captured, as it is removed or moved.
        cleaned: hide its floaters, as `shared/splats/floaters.py` finds them.
        recolor: color change of its splats and textures, or None.
        transform: affine map that moves it from its captured place, or None.
        copies: affine maps from its captured place to those of its duplicates.
        separated: it consists of single splats that the user took from other objects, so no mask and no model has it.
    """

    id: int
    name: str
    color: tuple[int, int, int]
    points: int
    merged_into: int | None = None
    left_out: bool = False
    removed: bool = False
    floaters: bool = False
    fill: bool = False
    cleaned: bool = False
    recolor: Recolor | None = None
    transform: Matrix | None = None
    copies: tuple[Matrix, ...] = ()
    separated: bool = False


def read_objects(path: Path) -> list[SceneObject]:
    """Return the objects with the user's edits, by ascending ID; raise InputError if the file is missing or invalid."""
    content = read_json(path)
    edits = _edits(content, path)
    try:
        voted = {entry["id"]: {**_renamed(entry), "separated": False} for entry in content["objects"]}
        made = {
            int(key): {"id": int(key), "name": "", "color": (0, 0, 0), "points": 0, "separated": True}
            for key, edit in edits.items()
            if edit.get("separated")
        }
        return [
            _object({**entry, **_known(edits.get(str(object_id), {})), "separated": entry["separated"]})
            for object_id, entry in sorted({**made, **voted}.items())
        ]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path} is not a valid list of objects ({error!r}); delete it and vote again.") from error


def write_objects(path: Path, objects: Sequence[Mapping[str, Any]]) -> None:
    """Replace the objects ({"id", "name", "color", "points"} each) and keep existing edits of them."""
    with _locked(path):
        edits = _edits(read_json(path), path) if path.exists() else {}
        voted = {str(entry["id"]) for entry in objects}
        kept = {key: edit for key, edit in edits.items() if not (key in voted and edit.get("separated"))}
        write_json(path, {"objects": list(objects), "edits": kept})


def forget_vanished(path: Path) -> None:
    """Remove the edits of IDs that no object has, so that another object that gets such an ID is not edited."""
    if not path.exists():
        return
    with _locked(path):
        content = read_json(path)
        edits = _edits(content, path)
        listed = {str(entry.id) for entry in read_objects(path)}
        write_json(path, {**content, "edits": {key: edit for key, edit in edits.items() if key in listed}})


Changes = Mapping[int, Mapping[str, Any]]
"""Object ID -> new values of fields in `EDITABLE`; None reverts an edit."""


def edit_objects(path: Path, changes: Changes | Callable[[list[SceneObject]], Changes]) -> None:
    """Store edits of objects.

    Args:
        path: objects.json.
        changes: The changes, or a function that computes them from the present objects while no other process can
            change the file.

    Raises:
        InputError: The file is missing or invalid, an object would be scaled to nothing, or another process keeps
            changing the file.
        ValueError: A field is not editable.
    """
    read_objects(path)  # Fail before the lock is created if the file is missing.
    with _locked(path):
        if callable(changes):
            changes = changes(read_objects(path))
        unknown = {key for change in changes.values() for key in change} - set(EDITABLE)
        if unknown:
            raise ValueError(f"{', '.join(sorted(unknown))} cannot be edited")
        if not changes:
            return
        for object_id, change in changes.items():
            places = [*filter(None, [change.get("transform")]), *(change.get("copies") or ())]
            if any(map(_flattens, places)):
                raise InputError(f"{path} is not changed, since object {object_id} would be scaled to nothing.")
        content = read_json(path)
        edits = _edits(content, path)
        for object_id, change in changes.items():
            kept = {**edits.get(str(object_id), {}), **change}
            edits[str(object_id)] = {key: value for key, value in kept.items() if value is not None}
        write_json(path, {**content, "edits": {key: value for key, value in edits.items() if value}})


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Wait until no other process changes objects.json, and exclude others; independent of the lock of the folder."""
    try:
        with locked(path.parent, _LOCK, _PATIENCE):
            yield
    except FolderInUse as error:
        raise InputError(f"{path} is being changed by another process; try again.") from error
    except OSError as error:
        error.filename = str(path)
        raise


def merged(objects: Sequence[SceneObject]) -> dict[int, int]:
    """Map each ID to the ID that it is shown as, following chains; merges into an unknown ID or itself are ignored."""
    return follow_merges({entry.id: entry.merged_into for entry in objects})


def follow_merges(into: Mapping[int, int | None]) -> dict[int, int]:
    """Do the work of `merged` on a mapping of each ID to the one that it is merged into, or None."""
    found = {}
    for start in into:
        at, seen = start, {start}
        while (after := into[at]) is not None and after in into and after not in seen:
            seen.add(after)
            at = after
        found[start] = at
    return found


def shown_as(objects: Sequence[SceneObject]) -> dict[int, int | None]:
    """Return which object stands for each object after merges.

    Args:
        objects: The objects with their edits.

    Returns:
        ID -> ID of the object that it is shown, meshed and exported as; None if that one or itself is left out. IDs of
        no object, which are not in the result, stand for themselves.
    """
    left_out = {entry.id for entry in objects if entry.left_out}
    return {i: None if {i, target} & left_out else target for i, target in merged(objects).items()}


def members_of(objects: Sequence[SceneObject], object_id: int) -> list[int]:
    """Return the ascending IDs of an object and of those that are merged into it; none if it is merged itself."""
    return sorted(i for i, target in merged(objects).items() if target == object_id)


def find_object(objects: Sequence[SceneObject], word: str, path: Path) -> SceneObject:
    """Find an object by ID, by name (ignoring case), or by a part of its name that is unique.

    Args:
        objects: The objects to search.
        word: The ID, name or part of a name.
        path: objects.json, for error messages.

    Returns:
        The object, or the one that it is merged into.

    Raises:
        InputError: No object matches, or several do; the message lists the objects.
    """
    shown, into = {entry.id: entry for entry in objects}, merged(objects)
    if word.isdecimal() and int(word) in shown:
        return shown[into[int(word)]]
    folded = word.casefold()
    meant = [entry for entry in objects if entry.name.casefold() == folded][:1]
    meant = meant or [entry for entry in objects if folded and folded in entry.name.casefold()]
    found = sorted({into[entry.id] for entry in meant})
    if len(found) == 1:
        return shown[found[0]]
    among = found or sorted({target for target in into.values() if not shown[target].left_out})
    there = ", ".join(f"{i} {shown[i].name}" for i in among[:20]) or "none"
    if len(among) > 20:
        there += f" and {len(among) - 20} more"
    if found:
        raise InputError(f"{word} may be several objects of {path}: {there}; specify one of them.")
    raise InputError(f"{path} has no object {word}; available objects: {there}.")


def default_name(object_id: int) -> str:
    """Return the name of an object without one; ID 0 stands for everything without an object."""
    return f"object {object_id}" if object_id else "Background"


def _object(entry: Mapping[str, Any]) -> SceneObject:
    red, green, blue = (_integer(channel, 255) for channel in entry["color"])
    object_id, into = _integer(entry["id"], LARGEST_ID), entry.get("merged_into")
    return SceneObject(
        id=object_id,
        name=_name(str(entry["name"])) or default_name(object_id),
        color=(red, green, blue),
        points=_integer(entry["points"], 2**31 - 1),
        merged_into=None if into is None else _integer(into, LARGEST_ID),
        left_out=bool(entry.get("left_out", False)),
        removed=bool(entry.get("removed", False)),
        floaters=bool(entry.get("floaters", False)),
        fill=bool(entry.get("fill", False)),
        cleaned=bool(entry.get("cleaned", False)),
        recolor=None if (recolor := entry.get("recolor")) is None else Recolor.of(recolor),
        transform=_placement(entry.get("transform")),
        copies=tuple(place for copy in entry.get("copies") or () if (place := _placement(copy)) is not None),
        separated=bool(entry["separated"]),
    )


def _integer(value: Any, largest: int) -> int:
    number = int(value)
    if not 0 <= number <= largest:
        raise ValueError(f"{value} is not between 0 and {largest}")
    return number


class _Singular(ValueError):
    """A map flattens what it moves."""


def _placement(value: Any) -> Matrix | None:
    """Convert a stored map; None if there is none, or a singular one, which earlier versions wrote."""
    try:
        return None if value is None else affine_map(value)
    except _Singular:
        return None


def _flattens(value: Any) -> bool:
    """Return whether a map to be stored is singular."""
    try:
        affine_map(value)
    except _Singular:
        return True
    except (TypeError, ValueError):
        pass  # The next reading reports it.
    return False


def is_singular(matrix: np.ndarray) -> bool:
    """Return whether a map (4, 4) flattens what it moves, such as that of an object which is scaled to nothing.

    Zero is zero within single precision, as of an object that Blender has scaled between rotations.
    """
    volume, sides = abs(np.linalg.det(matrix[:3, :3])), np.linalg.norm(matrix[:3, :3], axis=0)
    return bool(volume < 1e-30 or volume < 1e-6 * sides.prod())


def affine_map(value: Any) -> Matrix:
    """Convert four rows of four numbers to an affine map.

    Raises:
        ValueError, TypeError: They are not an affine map, or the map is singular.
    """
    matrix = np.array(value, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or not np.array_equal(matrix[3], (0, 0, 0, 1)):
        raise ValueError(f"{value} is not an affine map with four rows")
    if is_singular(matrix):
        raise _Singular(f"{value} is a singular map")
    first, second, third, last = (tuple(row) for row in matrix.tolist())
    return first, second, third, last


def _name(text: str) -> str:
    """Return `text` on one line as valid Unicode, which Blender requires but JSON escapes do not guarantee."""
    return " ".join(text.encode("utf-8", "replace").decode().replace("\0", " ").split())


def _edits(content: Any, path: Path) -> dict[str, dict[str, Any]]:
    edits = content.get("edits", {}) if isinstance(content, dict) else None
    if not isinstance(edits, dict) or not all(isinstance(edit, dict) for edit in edits.values()):
        raise InputError(f"{path} is not a valid list of objects; delete it and vote again.")
    return {object_id: _renamed(edit) for object_id, edit in edits.items()}


def _renamed(values: Mapping[str, Any]) -> dict[str, Any]:
    """Replace field names of older versions by the present ones."""
    return {_FORMER_NAMES.get(key, key): value for key, value in values.items()}


def _known(edit: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in edit.items() if key in EDITABLE}
