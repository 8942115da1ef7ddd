"""Which objects are made: those that are chosen (`--only`), and groups of IDs as one object each (`--groups`).

Both are edits as objects.json has them, so that they can be taken back in the list of objects.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from .errors import InputError
from .formats.json_file import read_json
from .reconstruction.objects import LARGEST_ID, SceneObject, find_object, merged

Changes = dict[int, dict[str, Any]]
"""Edits by ID, as `edit_objects` takes them."""


def read_groups(path: Path) -> dict[int, str]:
    """ID -> name of its group, from a labels file in which several IDs have one name: {"1": "chair", "2": "chair"}."""
    content = read_json(path)
    if not isinstance(content, dict) or not content:
        raise InputError(f'{path} has no groups; expected IDs and the name of each one\'s group: {{"1": "chair"}}.')
    groups = {}
    for word, name in content.items():
        if not word.isdecimal() or int(word) > LARGEST_ID:
            raise InputError(f"{path} groups {word!r}, which is no ID; expected a whole number as in the masks.")
        if not isinstance(name, str) or not name.strip():
            raise InputError(f"{path} gives ID {word} the group {name!r}; expected a name.")
        if int(word):
            groups[int(word)] = " ".join(name.split())
    return groups


def grouped(objects: Sequence[SceneObject], groups: Mapping[int, str], path: Path) -> Changes:
    """Make one object of the IDs that have one name in `groups`, read from `path`: the one with the smallest ID."""
    members: dict[str, list[int]] = defaultdict(list)
    for entry in sorted(objects, key=lambda entry: entry.id):
        if entry.id in groups:
            members[groups[entry.id]].append(entry.id)
    if not members:
        there = ", ".join(str(entry.id) for entry in objects[:20]) or "none"
        raise InputError(f"{path} groups none of the IDs that the masks show; there are: {there}.")
    changes: Changes = {}
    for name, (first, *others) in members.items():
        changes[first] = {"name": name, "merged_into": None}
        changes |= {other: {"merged_into": first} for other in others}
    return changes


def chosen(objects: Sequence[SceneObject], words: Sequence[str], path: Path) -> Changes:
    """Choose the objects that `words` name, with all that is merged into them, and leave out the others of `path`."""
    wanted, into = {find_object(objects, word, path).id for word in words}, merged(objects)
    return {entry.id: {"left_out": None if into[entry.id] in wanted else True} for entry in objects}


def changed(objects: Sequence[SceneObject], changes: Changes) -> list[SceneObject]:
    """The objects as they are after these changes."""
    found = []
    for entry in objects:
        change: dict[str, Any] = {**changes.get(entry.id, {})}
        if "left_out" in change:
            change["left_out"] = bool(change["left_out"])
        found.append(replace(entry, **change))
    return found
