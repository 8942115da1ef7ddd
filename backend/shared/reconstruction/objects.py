"""objects.json: the objects of a reconstruction as the votes found them, and what the user changed about them.

    {"objects": [{"id": 1, "name": "mug", "color": [59, 125, 216], "points": 812}, ...],
     "edits": {"1": {"name": "cup", "color": [255, 0, 0], "merged_into": 2, "left_out": true},
               "4": {"removed": true, "floaters": true, "fill": true},
               "5": {"recolor": {"hue": 0.3}, "transform": [[1, 0, 0, 2], ...], "copies": [[[1, 0, 0, 5], ...]]}, ...}}

A new vote replaces "objects" and keeps "edits". Standard library and NumPy only, so that Blender's own Python can
import it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..color.recolor import Recolor
from ..errors import InputError
from ..formats.json_file import read_json, write_json

LARGEST_ID = 2**32 - 1
EDITABLE = (
    "name", "color", "merged_into", "left_out", "removed", "floaters", "fill", "recolor", "transform", "copies",
)  # fmt: skip

_FORMER_NAMES = {"colour": "color", "recolour": "recolor"}
"""Of fields in files that older versions wrote."""

Matrix = tuple[tuple[float, float, float, float], ...]
"""Four rows of an affine map of the capture's coordinates, which moves an object from where it was captured."""


@dataclass(frozen=True)
class SceneObject:
    """One object: its ID in the masks, name, sRGB color 0 .. 255, how many points voted for it, and the user's edits.

    merged_into: the ID of the object that it is shown and meshed with, or None; left_out: not to be reconstructed;
    removed: made, but not to be seen, its copies neither; floaters: then what belongs to no object and lies inside its
    convex hull is not to be seen either; fill: then the ground or wall that it stands at is closed where it hid it;
    recolor: of its splats and textures, or None; transform: where it was moved to, or None; copies: where its
    duplicates are, from where it was captured. Edits of an object that is merged into
    another have no effect but its name; those of the other count for both.
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
    recolor: Recolor | None = None
    transform: Matrix | None = None
    copies: tuple[Matrix, ...] = ()


def read_objects(path: Path) -> list[SceneObject]:
    """The objects with the user's edits applied, by ascending ID; InputError where the file is missing or broken."""
    content = read_json(path)
    edits = _edits(content, path)
    try:
        return [
            _object({**_renamed(entry), **_known(edits.get(str(entry["id"]), {}))})
            for entry in sorted(content["objects"], key=lambda entry: entry["id"])
        ]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path} does not list objects as expected ({error!r}); delete it and vote again.") from error


def write_objects(path: Path, objects: Sequence[Mapping[str, Any]]) -> None:
    """Replace the objects ({"id", "name", "color", "points"} each) and keep the edits that are there."""
    edits = _edits(read_json(path), path) if path.exists() else {}
    write_json(path, {"objects": list(objects), "edits": edits})


def edit_objects(path: Path, changes: Mapping[int, Mapping[str, Any]]) -> None:
    """Change what the user may (`EDITABLE`) about objects, by ID; None takes an edit back to what the vote says."""
    unknown = {key for change in changes.values() for key in change} - set(EDITABLE)
    if unknown:
        raise ValueError(f"{', '.join(sorted(unknown))} cannot be edited")
    read_objects(path)  # Edits of objects that nobody can read would make a broken file look newer.
    content = read_json(path)
    edits = _edits(content, path)
    for object_id, change in changes.items():
        kept = {**edits.get(str(object_id), {}), **change}
        edits[str(object_id)] = {key: value for key, value in kept.items() if value is not None}
    write_json(path, {**content, "edits": {key: value for key, value in edits.items() if value}})


def merged(objects: Sequence[SceneObject]) -> dict[int, int]:
    """ID -> the ID that it is shown as, merges of merges followed; a merge into an unknown ID or itself is none."""
    into = {entry.id: entry.merged_into for entry in objects}
    found = {}
    for start in into:
        at, seen = start, {start}
        while (after := into[at]) is not None and after in into and after not in seen:
            seen.add(after)
            at = after
        found[start] = at
    return found


def find_object(objects: Sequence[SceneObject], word: str, path: Path) -> SceneObject:
    """The object that a word names: its ID, its name in any case, or a part of one object's name alone. What is merged
    into another stands for that one. InputError, which lists the objects of `path`, where none or several are meant."""
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
        raise InputError(f"{word} may be several objects of {path}: {there}; say which one.")
    raise InputError(f"{path} has no object {word}; there are: {there}.")


def default_name(object_id: int) -> str:
    """What an object is called that nobody has named; ID 0 is what belongs to no object."""
    return f"object {object_id}" if object_id else "Unlabeled"


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
        recolor=None if (recolor := entry.get("recolor")) is None else Recolor.of(recolor),
        transform=None if (transform := entry.get("transform")) is None else affine_map(transform),
        copies=tuple(affine_map(copy) for copy in entry.get("copies") or ()),
    )


def _integer(value: Any, largest: int) -> int:
    number = int(value)
    if not 0 <= number <= largest:
        raise ValueError(f"{value} is not between 0 and {largest}")
    return number


def affine_map(value: Any) -> Matrix:
    """Four rows of four numbers as a map; ValueError or TypeError where they are none, or flatten what they map."""
    matrix = np.array(value, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or not np.array_equal(matrix[3], (0, 0, 0, 1)):
        raise ValueError(f"{value} is no affine map of four rows")
    if abs(np.linalg.det(matrix[:3, :3])) < 1e-30:
        raise ValueError(f"{value} flattens what it maps")
    first, second, third, last = (tuple(row) for row in matrix.tolist())
    return first, second, third, last


def _name(text: str) -> str:
    """`text` on one line and as valid Unicode, which JSON's escapes need not be and Blender's names must."""
    return " ".join(text.encode("utf-8", "replace").decode().replace("\0", " ").split())


def _edits(content: Any, path: Path) -> dict[str, dict[str, Any]]:
    edits = content.get("edits", {}) if isinstance(content, dict) else None
    if not isinstance(edits, dict) or not all(isinstance(edit, dict) for edit in edits.values()):
        raise InputError(f"{path} does not list objects as expected; delete it and vote again.")
    return {object_id: _renamed(edit) for object_id, edit in edits.items()}


def _renamed(values: Mapping[str, Any]) -> dict[str, Any]:
    """Fields under the names that they have now."""
    return {_FORMER_NAMES.get(key, key): value for key, value in values.items()}


def _known(edit: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in edit.items() if key in EDITABLE}
