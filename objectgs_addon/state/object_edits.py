# SPDX-License-Identifier: GPL-3.0-or-later
"""User edits: the list of objects is filled from objects.json, and changes are written back to it.

Until the folder is accepted (`folder_trust`), changes of rows stay in the list. `accept` writes what was not `stored`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy

from ...backend.shared.color.recolor import Recolor
from ...backend.shared.errors import InputError
from ...backend.shared.grouping import grouped, read_groups
from ...backend.shared.reconstruction.folder import Reconstruction
from ...backend.shared.reconstruction.objects import EDITABLE, SceneObject, edit_objects, read_objects
from .. import scene
from ..blender import messages, undo, writing
from ..environment import known_folders
from ..picking import selection
from ..scene import from_stored, to_stored
from . import folder_trust, object_list

WRITE_AFTER = 0.4
"""Delay in seconds between the last change and writing new colors, since a dragged slider changes continuously."""

after_edits: list[Callable[[bpy.types.Collection], None]] = []
"""Callbacks that receive a reconstruction's collection after an edit that the backend may have to complete."""

_filling = False
_unwritten: dict[tuple[int, int], set[str]] = {}
"""(session UID of the collection, object ID) -> "color" or "recolor", which are not yet in objects.json."""


@contextmanager
def without_callbacks() -> Iterator[None]:
    """Set properties of rows without calling their update callbacks."""
    global _filling
    before, _filling = _filling, True
    try:
        yield
    finally:
        _filling = before


def fill(root: bpy.types.Collection, in_place: bool = False) -> None:
    """Fill the list from objects.json and what is shown; with `in_place`, which keeps its rows, only if they match."""
    flush()
    properties = root.objectgs
    path = Reconstruction(scene.folder_of(root)).objects
    entries = read_objects(path) if path.exists() else []
    shown, faces = object_list.splat_counts(root), object_list.face_counts(root)
    active_id = getattr(object_list.active_item(root), "object_id", None)
    with without_callbacks():
        if [item.object_id for item in properties.objects] != [to_stored(entry.id) for entry in entries]:
            if in_place:
                return
            properties.objects.clear()
            for _ in entries:
                properties.objects.add()
        for index, (item, entry) in enumerate(zip(properties.objects, entries)):
            item.name = entry.name
            item.object_id = to_stored(entry.id)
            item.color = [channel / 255.0 for channel in entry.color]
            item.chosen = not entry.left_out
            item.points = entry.points + sum(other.points for other in entries if other.merged_into == entry.id)
            item.splats = shown.get(entry.id, 0)
            item.faces = faces.get(entry.id, 0)
            item.is_merged = entry.merged_into is not None
            item.merged_into = to_stored(entry.merged_into or 0)
            item.removed, item.floaters, item.fill = entry.removed, entry.floaters, entry.fill
            item.cleaned, item.separated = entry.cleaned, entry.separated
            _set_sliders(item, entry.recolor)
            _remember(item)
            if item.object_id == active_id:
                properties.active_object = index
        properties.active_object = max(0, min(properties.active_object, len(entries) - 1))


def store(root: bpy.types.Collection, before: object_list.State) -> None:
    """Write to objects.json what an undo or redo has changed in the list and in the places of objects.

    What it has not changed is left as it is there, since another scene or program may have written it.
    """
    for mark in [mark for mark in _unwritten if mark[0] == root.session_uid]:
        del _unwritten[mark]
    path = Reconstruction(scene.folder_of(root)).objects
    if not folder_trust.is_accepted(root) or not path.exists():
        return
    entries = {entry.id: entry for entry in read_objects(path)}
    rows = object_list.state_of(root).rows
    if {i for i in rows if not rows[i]["separated"]} != {i for i in entries if not entries[i].separated}:
        return
    gone = (entries.keys() & before.rows.keys()) - rows.keys()
    changes: dict[int, dict] = {object_id: dict.fromkeys(EDITABLE) for object_id in gone}
    for object_id, row in rows.items():
        stored = object_list.row_of(entries.get(object_id, SceneObject(object_id, "", (0, 0, 0), 0)))
        was = before.rows.get(object_id)
        changed = {
            key: value for key, value in row.items() if value != stored[key] and (was is None or value != was[key])
        }
        if changed:
            changes[object_id] = changed
    if changes:
        edit_objects(path, changes)
    for item in root.objectgs.objects:
        _remember(item)
    scene.store_placements(root, before.places)


def store_edits(root: bpy.types.Collection) -> None:
    """Write pending edits to objects.json before it is read elsewhere, if the folder is accepted."""
    flush()
    if folder_trust.is_accepted(root):
        with undo.step_for_links("Transforms and Duplicates"):
            scene.store_placements(root)


def accept(root: bpy.types.Collection, folder: Path) -> bool:
    """Use `folder` for a reconstruction from now on, and write the edits that were kept in the .blend.

    Returns:
        Whether the folder is still accepted after Blender is closed.

    Raises:
        InputError: the path is not absolute, and nothing is changed; or the folder's files cannot be used, and the
            folder is accepted all the same, so that its files can be made again.
        OSError: objects.json cannot be written; nothing is changed.
    """
    if not known_folders.can_be_known(folder):
        raise InputError(f"This file does not name its reconstruction folder ({folder}); choose another.")
    failure = None
    try:
        written = _write_kept(root, Reconstruction(folder).objects)
    except InputError as error:
        failure, written = error, {}
    if folder != scene.folder_of(root):
        scene.link_folder(root, folder)
    is_remembered = known_folders.remember(folder)
    if failure is not None:
        raise failure
    store_edits(root)
    if not root.objectgs.objects:
        fill(root)
    elif any("left_out" in change for change in written.values()):
        show(root)
    return is_remembered


def _write_kept(root: bpy.types.Collection, path: Path) -> dict[int, dict[str, Any]]:
    """Write the kept edits of rows to objects.json at `path`, and return them by object ID."""
    known = {entry.id for entry in read_objects(path)} if path.exists() else set()
    items = [item for item in root.objectgs.objects if from_stored(item.object_id) in known]
    changes = {from_stored(item.object_id): change for item in items if (change := _kept(item))}
    if changes:
        edit_objects(path, changes)
    for item in items:
        _remember(item)
    return changes


def merge(root: bpy.types.Collection, object_ids: Iterable[int], into: int) -> None:
    """Merge objects into the object `into`."""
    _edit(root, {object_id: {"merged_into": into} for object_id in object_ids if object_id != into})


def split(root: bpy.types.Collection, object_id: int) -> int:
    """Undo every merge into `object_id` and its own merge, and return their number."""
    apart = [
        from_stored(item.object_id)
        for item in root.objectgs.objects
        if item.is_merged and (from_stored(item.merged_into) == object_id or from_stored(item.object_id) == object_id)
    ]
    _edit(root, {part: {"merged_into": None} for part in apart})
    return len(apart)


def group(root: bpy.types.Collection, labels: Path) -> None:
    """Merge IDs that have the same name in a labels file; raise InputError if the file is not a labels file."""
    objects = read_objects(Reconstruction(scene.folder_of(root)).objects)
    _edit(root, grouped(objects, read_groups(labels), labels))


def choose(root: bpy.types.Collection, chosen: dict[int, bool]) -> None:
    """Set for each ID whether it is trained as an object."""
    _edit(root, {object_id: {"left_out": None if wanted else True} for object_id, wanted in chosen.items()})


def _edit(root: bpy.types.Collection, changes: dict[int, dict]) -> None:
    """Write edits to objects.json and show them."""
    if not changes:
        return
    folder_trust.require_accepted(root)
    _require_object_mode(root)
    store_edits(root)
    edit_objects(Reconstruction(scene.folder_of(root)).objects, changes)
    try:
        if object_list.scenes_of(root):
            show(root)
    finally:
        fill(root)
    notify(root)


def show(root: bpy.types.Collection) -> None:
    """Update the collections from the folder."""
    folder = scene.folder_of(root)
    if Reconstruction(folder).splats.exists():
        scene.show_result(root, folder)
    else:
        scene.show_objects(root, folder, is_vote=False)


def remove(root: bpy.types.Collection, object_ids: Iterable[int], floaters: bool, fill: bool = False) -> None:
    """Hide objects until they are restored.

    Args:
        root: the reconstruction's collection.
        object_ids: IDs of the objects.
        floaters: also hide the unlabeled splats inside the objects.
        fill: fill the holes in the ground or walls behind the objects.
    """
    change = {"removed": True, "floaters": floaters or None} | ({"fill": True} if fill else {})
    _show_edit(root, dict.fromkeys(object_ids, change))


def restore(root: bpy.types.Collection, object_ids: Iterable[int]) -> None:
    """Show removed objects again, unchanged."""
    _show_edit(root, {object_id: object_list.restored(root, object_id) for object_id in object_ids})


def fill_hole(root: bpy.types.Collection, object_id: int, is_filled: bool) -> None:
    """Fill the hole where a removed or moved object was captured, or remove the fill."""
    _show_edit(root, {object_id: {"fill": is_filled or None}})


def clean_floaters(root: bpy.types.Collection, object_ids: Iterable[int], are_hidden: bool) -> None:
    """Hide the floaters of objects, or show them again."""
    _show_edit(root, {object_id: {"cleaned": are_hidden or None} for object_id in object_ids})


def reset_colors(root: bpy.types.Collection, object_ids: Iterable[int]) -> None:
    """Reset objects to their captured colors."""
    _show_edit(root, {object_id: {"recolor": None} for object_id in object_ids})


def _show_edit(root: bpy.types.Collection, changes: dict[int, dict]) -> None:
    """Write edits to objects.json and show them, for edits that require no splats from the folder."""
    folder_trust.require_accepted(root)
    _require_object_mode(root)
    flush()
    folder = scene.folder_of(root)
    edit_objects(Reconstruction(folder).objects, changes)
    try:
        scene.show_edits(root, scene.Objects.read(folder))
    finally:
        fill(root)
    notify(root)


def notify(root: bpy.types.Collection) -> None:
    """Call the callbacks `after_edits`."""
    for call in after_edits:
        call(root)


def flush(is_shown: bool = True) -> None:
    """Write pending colors; show them on points and in other scenes unless undo or another file is about to."""
    waiting = dict(_unwritten)
    _unwritten.clear()
    for root in [root for root in bpy.data.collections if waiting and scene.kind_of(root) == "reconstruction"]:
        if scene.is_linked(root) or not folder_trust.is_accepted(root):
            continue
        marks = ((item, (root.session_uid, from_stored(item.object_id))) for item in root.objectgs.objects)
        items = [(item, waiting[mark]) for item, mark in marks if mark in waiting]
        if items:
            _write_colors(root, items, is_shown)


def _write_colors(root: bpy.types.Collection, items: list[tuple[Any, set[str]]], is_shown: bool) -> None:
    """Write the named colors of rows."""
    values = {"color": object_list.rgb_of, "recolor": lambda item: object_list.recolor_of(item).stored()}
    changes = {from_stored(item.object_id): {name: values[name](item) for name in names} for item, names in items}
    try:
        edit_objects(Reconstruction(scene.folder_of(root)).objects, changes)
    except (InputError, OSError) as error:
        for item, _ in items:
            _restore(item)
            _show_label(item)
            scene.recolor(root, from_stored(item.object_id), object_list.recolor_of(item))
        messages.show(f"Colors were not changed: {messages.sentence(error)}", "ERROR")
        return
    for item, _ in items:
        _remember(item, colors_only=True)
    if is_shown and any("color" in names for _, names in items):
        with undo.step_for_links("Colors"):
            _show_written(root)


def _show_label(item: Any) -> None:
    """Show the name and the color of a row on its object, without its folder."""
    red, green, blue = object_list.rgb_of(item)
    scene.show_label(item.id_data, from_stored(item.object_id), item.name, (red, green, blue))


def _set_sliders(item: Any, recolor: Recolor | None) -> None:
    wanted = recolor or Recolor()
    for name in (*object_list.SLIDERS, *object_list.COLORS):
        setattr(item, name, getattr(wanted, name))
    item.middle = wanted.middle if recolor is not None else 0.0


# Update callbacks of the rows' properties.


def name_changed(item: Any, _context: bpy.types.Context) -> None:
    if _filling:
        return
    name = " ".join(item.name.split())
    if not name:
        flush()
        _restore(item)
        return
    with without_callbacks():
        item.name = name
    _row_changed(item, name=name)


def color_changed(item: Any, _context: bpy.types.Context) -> None:
    """Show a new color immediately and schedule writing it, since it may be dragged."""
    if _filling:
        return
    _show_label(item)
    if folder_trust.is_accepted(item.id_data):
        _write_later(item, "color")


def chosen_changed(item: Any, _context: bpy.types.Context) -> None:
    _row_changed(item, left_out=None if item.chosen else True)


def recolor_changed(item: Any, _context: bpy.types.Context) -> None:
    """Show the color of a moved slider immediately and schedule writing it."""
    if _filling:
        return
    root, object_id = item.id_data, from_stored(item.object_id)
    collection = scene.object_collections(root).get(object_id)
    if collection is None:
        _restore(item)
        return
    if not item.middle:
        with without_callbacks():
            item.middle = scene.luma_of(collection)
    scene.recolor(root, object_id, object_list.recolor_of(item))
    _write_later(item, "recolor")


def _write_later(item: Any, name: str) -> None:
    """Write a color of a row once it has not changed for a moment."""
    _unwritten.setdefault((item.id_data.session_uid, from_stored(item.object_id)), set()).add(name)
    writing.later(_flush_later, WRITE_AFTER)


@writing.allowed
def _flush_later() -> None:
    flush()


@undo.left_to_blender()
def _row_changed(item: Any, **changes: Any) -> None:
    """Store an edit of a row, or revert it on failure, since update callbacks must not raise."""
    if _filling:
        return
    root = item.id_data
    if not folder_trust.is_accepted(root):
        _show_label(item)
        return
    try:
        store_edits(root)
        _require_object_mode(root)
        edit_objects(Reconstruction(scene.folder_of(root)).objects, {from_stored(item.object_id): changes})
    except (InputError, OSError) as error:
        _restore(item)
        messages.show(f"{item.name} was not changed: {messages.sentence(error)}", "ERROR")
        return
    _remember(item)
    _show_written(root)


def _show_written(root: bpy.types.Collection) -> None:
    """Show names and colors in the folder on points and in the other scenes."""
    try:
        if object_list.scenes_of(root):
            scene.show_objects(root, scene.folder_of(root), is_vote=False)
            fill(root, in_place=True)  # An update callback must not remove its row.
        notify(root)
    except (InputError, OSError) as error:
        messages.show(messages.sentence(error), "ERROR")


def _require_object_mode(root: bpy.types.Collection) -> None:
    """Raise InputError if a part is in Edit Mode, where an edit could not be shown."""
    scene.require_object_mode(part for part in root.all_objects if scene.kind_of(part) is not None)


def _remember(item: Any, colors_only: bool = False) -> None:
    """Store the state that a failed edit reverts to, with `colors_only` but for the name and the check box."""
    name, _, chosen, *_ = json.loads(item.stored) if colors_only and item.stored else (item.name, None, item.chosen)
    stored = json.dumps([name, list(item.color), chosen, object_list.recolor_of(item).stored()])
    if item.stored != stored:
        item.stored = stored


def _kept(item: Any) -> dict[str, Any]:
    """Return the fields of a row that differ from its stored state, as edits of objects.json."""
    try:
        name, color, chosen, *recolor = json.loads(item.stored)
    except (ValueError, TypeError):
        return {}
    now = json.loads(json.dumps(object_list.recolor_of(item).stored()))
    return {
        **({"name": item.name} if item.name != name else {}),
        **({"color": object_list.rgb_of(item)} if list(item.color) != color else {}),
        **({"left_out": None if item.chosen else True} if item.chosen != chosen else {}),
        **({"recolor": now} if recolor and now != recolor[0] else {}),
    }


def _restore(item: Any) -> None:
    """Revert a failed edit."""
    if item.stored:
        with without_callbacks():
            item.name, item.color, item.chosen, *recolor = json.loads(item.stored)
            if recolor:  # Missing in files of older versions.
                _set_sliders(item, Recolor.of(recolor[0]) if recolor[0] else None)


def active_changed(properties: Any, context: bpy.types.Context) -> None:
    """Select the clicked object of the list in the viewport, or nothing if it is hidden, so that edits act on it."""
    if _filling or context.mode != "OBJECT":
        return  # Another active object would leave that in Edit Mode behind.
    root, item = properties.id_data, object_list.active_item(properties.id_data)
    target = None if item is None else object_list.merge_target(root, from_stored(item.object_id))
    if target is not None and not selection.select_object(context, root, target):
        selection.select_nothing(context)
