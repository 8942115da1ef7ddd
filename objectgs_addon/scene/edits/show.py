# SPDX-License-Identifier: GPL-3.0-or-later
"""Two-way sync of removal, recoloring, placement and duplicates of objects between Blender and objects.json.

Users can change placements and duplicates in Blender at any time, so either side may be newer. Each collection
therefore stores the values of objects.json and the placement of its parts at the last sync.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

import bpy
import numpy as np

from ....backend.shared.color.recolor import Recolor
from ....backend.shared.reconstruction.folder import Reconstruction
from ....backend.shared.reconstruction.objects import SceneObject, edit_objects, is_singular, read_objects
from .. import carrier
from ..capture import origin_of
from ..kinds import OBJECT_PARENT, SPLATS, duplicates_of, folder_of, object_collections, part_of, whole_duplicates_of
from ..object_display import Objects
from .duplicates import DUPLICATES, adopt_blender_duplicates, bring_up_to_date, duplicate, remove_duplicate
from .fills import show_fills
from .floaters import hide_floaters
from .placement import (
    PLACEMENT,
    ROUNDING,
    about,
    is_rounding,
    local_placement,
    placement_of,
    rest_placement,
    set_placement,
)
from .recolor import recolor_of, set_recolor
from .recover import recover_parts

REMOVED = "objectgs_removed"
"""Custom property of a removed object's collection: its previous visibility flags for viewports and renders."""


def show_edits(root: bpy.types.Collection, objects: Objects) -> None:
    """Apply removals, recoloring, placements and duplicates from objects.json.

    Objects that the user has moved since keep their placement, unless the placement in objects.json has changed. Copies
    made with Blender's own operators are converted to duplicates in Object Mode, where they get an undo step. Only
    there do duplicates follow their originals, since parts that the user moved elsewhere are recovered first.

    Args:
        root: the reconstruction's collection.
        objects: the objects with the user's edits.

    Raises:
        InputError: Splats that would change are in Edit Mode.
    """
    is_free = bpy.context.mode == "OBJECT"
    if is_free:
        recover_parts(root)
    collections = object_collections(root)
    entries = objects.entries.values()
    hiding = {entry.id for entry in entries if entry.cleaned}
    hiding |= {0 for entry in entries if entry.removed and entry.floaters}
    carrier.require_object_mode(part_of(collections[object_id], SPLATS) for object_id in hiding & collections.keys())
    show_fills(root, objects)
    if is_free:
        adopt_blender_duplicates(root)
        bring_up_to_date(root)
    copies = duplicates_of(root)
    for object_id, collection in collections.items():
        entry = objects.entries.get(object_id)
        if entry is None:
            continue
        _show_place(root, collection, entry.transform)
        all_of_it = [collection, *_show_copies(root, collection, copies.get(object_id, []), entry)]
        for each in all_of_it:
            _set_removed(each, entry.removed)
            if entry.recolor is not None or recolor_of(each) is not None:
                set_recolor(each, entry.recolor)
    hide_floaters(root, objects.entries)


def recolor(root: bpy.types.Collection, object_id: int, wanted: Recolor | None) -> bool:
    """Recolor an object and its duplicates without writing objects.json; return False if it has no collection."""
    collection = object_collections(root).get(object_id)
    if collection is None:
        return False
    for each in (collection, *duplicates_of(root).get(object_id, ())):
        set_recolor(each, wanted)
    return True


Places = tuple[list | None, list]
"""An object's placement, None where it was captured, and those of its duplicates, as in objects.json."""


def places_of(root: bpy.types.Collection) -> dict[int, Places]:
    """Return where the objects of a reconstruction are now, by ID."""
    copies = whole_duplicates_of(root)
    return {
        object_id: (_place(root, collection), [_place(root, copy) or _IDENTITY for copy in copies.get(object_id, ())])
        for object_id, collection in object_collections(root).items()
        if local_placement(root, collection) is not None
    }


def shows_places(root: bpy.types.Collection, entries: Iterable[SceneObject]) -> bool:
    """Return whether objects of objects.json have the placements and duplicates that they had at the last sync."""
    collections = object_collections(root)
    return all(
        _rows(entry.transform) == _agreed_place(collections[entry.id])
        and [_rows(copy) for copy in entry.copies] == _agreed_copies(collections[entry.id])
        for entry in entries
        if entry.id in collections
    )


def store_placements(root: bpy.types.Collection, before: Mapping[int, Places] | None = None) -> None:
    """Write placements and duplicates that the user changed to objects.json.

    Copies made with Blender's own operators are converted to duplicates in Object Mode, where they get an undo step.

    Args:
        root: the reconstruction's collection.
        before: after an undo, where objects were before it; those that it has moved are compared with the file, as it
            has also undone what they remember of the file. No duplicates are then converted or removed, since undo
            could free their data-blocks while others refer to them.

    Raises:
        InputError: objects.json cannot be used.
        OSError: objects.json cannot be written.
    """
    path = Reconstruction(folder_of(root)).objects
    if not path.exists():
        return
    if before is None and bpy.context.mode == "OBJECT":
        recover_parts(root)
        adopt_blender_duplicates(root)
        for twins in duplicates_of(root).values():
            for copy in [copy for copy in twins if part_of(copy, OBJECT_PARENT) is None]:
                remove_duplicate(copy)  # The user deleted its pivot.
        bring_up_to_date(root)
    copies, collections = whole_duplicates_of(root), object_collections(root)
    now = places_of(root)
    # What is scaled to nothing, as at the beginning of an animation, keeps its place in the file.
    now = {object_id: places for object_id, places in now.items() if not _is_flat(places)}
    if before is None:
        changed = {
            object_id
            for object_id, (place, copied) in now.items()
            if place != _agreed_place(collections[object_id]) or copied != _agreed_copies(collections[object_id])
        }
    else:
        changed = {object_id for object_id, places in now.items() if places != before.get(object_id)}
    if not changed:
        return
    entries = {entry.id: entry for entry in read_objects(path)}
    changes: dict[int, dict] = {}
    for object_id in changed & entries.keys():
        entry, (place, copied) = entries[object_id], now[object_id]
        change = {}
        if not _same(root, [entry.transform], [place]):
            change["transform"] = place
        if not _same(root, entry.copies, copied):
            change["copies"] = copied or None
        if change:
            changes[object_id] = change
    if changes:
        edit_objects(path, changes)
    for object_id in now.keys() & entries.keys():
        place, copied = now[object_id]
        change = changes.get(object_id, {})
        entry = entries[object_id]
        if object_id not in changed and not (
            _same(root, [entry.transform], [place]) and _same(root, entry.copies, copied)
        ):
            continue  # Another file or program has moved it, which Reload Result is to show.
        _agree(root, collections[object_id], change["transform"] if "transform" in change else _rows(entry.transform))
        stored = change["copies"] or [] if "copies" in change else [_rows(copy) for copy in entry.copies]
        for copy, matrix in zip(copies.get(object_id, ()), stored):
            _agree(root, copy, matrix)
        _agree_copies(collections[object_id], stored)


_IDENTITY = np.eye(4).tolist()


def _show_place(root: bpy.types.Collection, collection: bpy.types.Collection, transform: Any) -> None:
    wanted = _rows(transform)
    if wanted != _agreed_place(collection):
        set_placement(root, collection, wanted)
        _agree(root, collection, wanted)


def _show_copies(
    root: bpy.types.Collection, collection: bpy.types.Collection, there: list, entry: SceneObject
) -> list[bpy.types.Collection]:
    """Update an object's duplicates from the file and return their collections."""
    wanted = [_rows(copy) for copy in entry.copies]
    if wanted == _agreed_copies(collection):
        return there
    missing, kept = list(wanted), []
    for copy in there:
        agreed = _agreed_place(copy)
        if agreed in missing:
            missing.remove(agreed)
            kept.append(copy)
        else:
            remove_duplicate(copy)
    for place in missing:
        copy = duplicate(root, collection)
        set_placement(root, copy, place)
        _agree(root, copy, place)
        kept.append(copy)
    _agree_copies(collection, wanted)
    return kept


def _set_removed(collection: bpy.types.Collection, removed: bool) -> None:
    if removed:
        if REMOVED not in collection:
            collection[REMOVED] = [int(collection.hide_viewport), int(collection.hide_render)]
        if not collection.hide_viewport or not collection.hide_render:
            collection.hide_viewport = collection.hide_render = True
    elif REMOVED in collection:
        collection.hide_viewport, collection.hide_render = (bool(before) for before in collection[REMOVED])
        del collection[REMOVED]


def is_removed(collection: bpy.types.Collection) -> bool:
    """Return whether the object of a collection has been removed."""
    return REMOVED in collection


def _place(root: bpy.types.Collection, collection: bpy.types.Collection) -> list | None:
    """Return an object's placement for objects.json; the stored value is kept exactly if the object has not moved."""
    local = local_placement(root, collection)
    if local is None:
        return None
    agreed = json.loads(collection[PLACEMENT]) if PLACEMENT in collection else None
    if agreed is not None and is_rounding(part_of(collection, OBJECT_PARENT), local - np.array(agreed["local"])):
        return agreed["stored"]
    place = placement_of(root, collection).tolist()
    return None if _same(root, [None], [place]) else place


def _is_flat(places: Places) -> bool:
    """Return whether an object or one of its duplicates is scaled to nothing."""
    return any(is_singular(np.array(place)) for place in (places[0] or _IDENTITY, *places[1]))


def _agreed_place(collection: bpy.types.Collection) -> list | None:
    return json.loads(collection[PLACEMENT])["stored"] if PLACEMENT in collection else None


def _agree(root: bpy.types.Collection, collection: bpy.types.Collection, stored: list | None) -> None:
    local = local_placement(root, collection)
    if stored is None and (local is None or np.array_equal(local, rest_placement(collection))):
        if PLACEMENT in collection:
            del collection[PLACEMENT]
        return
    if local is not None:
        collection[PLACEMENT] = json.dumps({"stored": stored, "local": local.tolist()})


def _agreed_copies(collection: bpy.types.Collection) -> list:
    return json.loads(collection.get(DUPLICATES, "[]"))


def _agree_copies(collection: bpy.types.Collection, stored: list) -> None:
    if stored:
        collection[DUPLICATES] = json.dumps(stored)
    elif DUPLICATES in collection:
        del collection[DUPLICATES]


def _rows(matrix: Any) -> list | None:
    return None if matrix is None else [list(row) for row in matrix]


def _same(root: bpy.types.Collection, first: Any, second: Any) -> bool:
    """Return whether two lists hold equal maps within single precision; None is the identity."""
    origin = origin_of(root)
    if len(first) != len(second):
        return False
    for one, other in zip(first, second):
        if one is other:
            continue  # Usually both are None.
        # Far from the origin, the translation of a map that turns or scales is much larger than the object's move.
        one, other = (about(np.array(_IDENTITY if each is None else each, float), -origin) for each in (one, other))
        if not np.allclose(one, other, ROUNDING, ROUNDING):
            return False
    return True
