"""Selection of the objects to reconstruct (`--only`), and grouping of IDs into one object (`--groups`).

Both produce edits for objects.json, so they can be reverted in the list of objects.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from .class_table import LARGEST_ID
from .errors import InputError
from .formats.json_file import read_json
from .reconstruction.objects import SceneObject, find_object, merged

Changes = dict[int, dict[str, Any]]
"""Object ID -> edits, as for `edit_objects`."""


def read_groups(path: Path) -> dict[int, str]:
    """Read ID -> name of its group from a labels file that gives IDs the same name: {"1": "chair", "2": "chair"}."""
    content = read_json(path)
    if not isinstance(content, dict) or not content:
        raise InputError(f'{path} has no groups; expected IDs and the name of each one\'s group: {{"1": "chair"}}.')
    groups = {}
    for word, name in content.items():
        if not word.isdecimal() or int(word) > LARGEST_ID:
            raise InputError(
                f"{path} contains {word!r}, which is not an object ID; expected an integer as in the masks."
            )
        if not isinstance(name, str) or not name.strip():
            raise InputError(f"{path} gives ID {word} the group {name!r}; expected a name.")
        if int(word):
            groups[int(word)] = " ".join(name.split())
    return groups


def grouped(objects: Sequence[SceneObject], groups: Mapping[int, str], path: Path) -> Changes:
    """Merge the objects of each group into the one with the smallest ID, which gets the name of the group.

    Args:
        objects: The objects of a reconstruction.
        groups: ID -> name of its group, as from `read_groups`; IDs of no object are ignored.
        path: The file of the groups, for error messages.

    Returns:
        The edits, which also undo earlier merges of these objects.

    Raises:
        InputError: `groups` contains none of the objects.
    """
    members: dict[str, list[int]] = defaultdict(list)
    for entry in sorted(objects, key=lambda entry: entry.id):
        if entry.id in groups:
            members[groups[entry.id]].append(entry.id)
    if not members:
        there = ", ".join(str(entry.id) for entry in objects[:20]) or "none"
        raise InputError(f"{path} contains none of the IDs in the masks; available IDs: {there}.")
    changes: Changes = {}
    for name, (first, *others) in members.items():
        changes[first] = {"name": name, "merged_into": None}
        changes |= {other: {"merged_into": first} for other in others}
    return changes


def chosen(objects: Sequence[SceneObject], words: Sequence[str], path: Path) -> Changes:
    """Leave out all objects but the selected ones and those merged into them.

    Args:
        objects: The objects of a reconstruction.
        words: IDs, names or parts of names, as in `find_object`.
        path: objects.json or the folder of the masks, for error messages.

    Returns:
        The edits, which also undo that a selected object was left out.

    Raises:
        InputError: A word matches no object or several.
    """
    wanted, into = {find_object(objects, word, path).id for word in words}, merged(objects)
    return {entry.id: {"left_out": None if into[entry.id] in wanted else True} for entry in objects}


def changed(objects: Sequence[SceneObject], changes: Changes) -> list[SceneObject]:
    """Return the objects with the changes applied."""
    found = []
    for entry in objects:
        change: dict[str, Any] = {**changes.get(entry.id, {})}
        if "left_out" in change:
            change["left_out"] = bool(change["left_out"])
        found.append(replace(entry, **change))
    return found
