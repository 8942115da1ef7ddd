# SPDX-License-Identifier: GPL-3.0-or-later
"""The objects list and objects.json: filled from the file, and the user's edits written back to it."""

import json
from collections.abc import Callable, Iterable
from contextlib import contextmanager
from pathlib import Path

import bpy

from ..backend.objects import SceneObject, edit_objects, merged, read_objects
from ..backend.planning.choosing import grouped, read_groups
from ..backend.protocol import InputError, Reconstruction
from ..backend.recolour import Recolour
from . import messages, scene, selection, writing
from .scene import from_stored, to_stored

WRITE_AFTER = 0.4
"""Seconds without another change after which new colours are written: a slider that is dragged changes all the time."""

SLIDERS = ("amount", "hue", "saturation", "value", "contrast")
COLOURS = ("replace", "tint")
DIGITS = 6
"""Decimals of a slider's value: Blender's numbers have no more."""

after_edits: list[Callable[[bpy.types.Collection], None]] = []
"""Called with a reconstruction's collection once an edit that the backend may have to do something for is shown."""

_filling = False
_unwritten: set[tuple[int, int]] = set()
"""(session's ID of a reconstruction's collection, object ID) of new colours that objects.json does not have yet."""


@contextmanager
def without_callbacks():
    """Rows are being set by code: their update callbacks must not take that for an edit."""
    global _filling
    before, _filling = _filling, True
    try:
        yield
    finally:
        _filling = before


def fill(root) -> None:
    """Make the list agree with objects.json and with the splats that are shown; empty where there was no vote yet."""
    flush()
    properties = root.objectgs
    path = Reconstruction(scene.folder_of(root)).objects
    entries = read_objects(path) if path.exists() else []
    shown, faces = splat_counts(root), face_counts(root)
    active = active_item(root)
    active_id = active.object_id if active else None
    with without_callbacks():
        properties.objects.clear()
        for entry in entries:
            item = properties.objects.add()
            item.name = entry.name
            item.object_id = to_stored(entry.id)
            item.colour = [channel / 255.0 for channel in entry.colour]
            item.chosen = not entry.left_out
            item.points = entry.points
            item.splats = shown.get(entry.id, 0)
            item.faces = faces.get(entry.id, 0)
            item.is_merged = entry.merged_into is not None
            item.merged_into = to_stored(entry.merged_into or 0)
            item.removed, item.floaters, item.fill = entry.removed, entry.floaters, entry.fill
            _set_sliders(item, entry.recolour)
            _remember(item)
            if item.object_id == active_id:
                properties.active_object = len(properties.objects) - 1
        properties.active_object = max(0, min(properties.active_object, len(entries) - 1))


def splat_counts(root) -> dict[int, int]:
    """Object ID -> how many splats its collection shows, merged ones included."""
    return {
        object_id: sum(len(part.data.vertices) - int(scene.invented_splats(part.data).sum())
                       for part in scene.parts_of(collection) if scene.kind_of(part) == "splats")
        for object_id, collection in scene.object_collections(root).items()
    }


def face_counts(root) -> dict[int, int]:
    """Object ID -> how many faces the meshes in its collection have, of the objects that have any."""
    return {object_id: sum(len(mesh.data.polygons) for mesh in meshes)
            for object_id, meshes in scene.object_meshes(root).items()}


def store(root) -> None:
    """Write back what the list and the collections say, after undo or redo changed them."""
    _unwritten.difference_update([mark for mark in _unwritten if mark[0] == root.session_uid])
    path = Reconstruction(scene.folder_of(root)).objects
    if not path.exists():
        return
    entries = {entry.id: entry for entry in read_objects(path)}
    items = {from_stored(item.object_id): item for item in root.objectgs.objects}
    if set(items) != set(entries):
        return
    changes = {}
    for object_id, item in items.items():
        entry = entries[object_id]
        wanted = {"name": item.name, "colour": _rgb(item), "left_out": None if item.chosen else True,
                  "merged_into": from_stored(item.merged_into) if item.is_merged else None,
                  "removed": item.removed or None, "floaters": item.floaters or None, "fill": item.fill or None,
                  "recolour": recolour_of(item).stored()}
        there = {"name": entry.name, "colour": list(entry.colour), "left_out": entry.left_out or None,
                 "merged_into": entry.merged_into, "removed": entry.removed or None,
                 "floaters": entry.floaters or None, "fill": entry.fill or None,
                 "recolour": _rounded(entry.recolour).stored()}
        changed = {key: value for key, value in wanted.items() if value != there[key]}
        if changed:
            changes[object_id] = changed
    if changes:
        edit_objects(path, changes)
    scene.store_places(root, everything=True)


def store_edits(root) -> None:
    """Bring objects.json up to date with what the user did in Blender: before something else reads it."""
    flush()
    scene.store_places(root)


def merge(root, object_ids, into: int) -> None:
    """Show `object_ids` as parts of the object `into` from now on."""
    _edit(root, {object_id: {"merged_into": into} for object_id in object_ids if object_id != into})


def split(root, object_id: int) -> int:
    """Take back every merge into `object_id`, and its own; returns how many there were."""
    items = root.objectgs.objects
    apart = [from_stored(item.object_id) for item in items if item.is_merged and (
        from_stored(item.merged_into) == object_id or from_stored(item.object_id) == object_id)]
    _edit(root, {part: {"merged_into": None} for part in apart})
    return len(apart)


def group(root, labels: Path) -> None:
    """Make one object of the IDs that a labels file gives one name; InputError where it is none."""
    objects = read_objects(Reconstruction(scene.folder_of(root)).objects)
    _edit(root, grouped(objects, read_groups(labels), labels))


def choose(root, chosen: dict[int, bool]) -> None:
    """Say for each ID whether training is to make it an object."""
    _edit(root, {object_id: {"left_out": None if wanted else True} for object_id, wanted in chosen.items()})


def _edit(root, changes: dict[int, dict]) -> None:
    """Write edits to objects.json and show them."""
    if not changes:
        return
    _require_object_mode(root)
    store_edits(root)
    edit_objects(Reconstruction(scene.folder_of(root)).objects, changes)
    try:
        for owner in scenes_of(root)[:1]:
            show(root, owner)
    finally:
        fill(root)
    _tell(root)


def show(root, owner) -> None:
    """Bring Blender's collections into agreement with the folder."""
    folder = scene.folder_of(root)
    if Reconstruction(folder).splats.exists():
        scene.show_result(root, folder, owner)
    else:
        scene.show_objects(root, folder, owner)


def remove(root, object_ids: Iterable[int], floaters: bool, fill: bool = False) -> None:
    """Make objects invisible, until they are restored; floaters: with what floats unlabelled inside them; fill: and
    the ground or wall that they hid is closed."""
    change = {"removed": True, "floaters": floaters or None, "fill": fill or None}
    _show_edit(root, dict.fromkeys(object_ids, change))


def restore(root, object_ids: Iterable[int]) -> None:
    """Make removed objects visible again, exactly as they were."""
    _show_edit(root, {object_id: {"removed": None, "floaters": None, "fill": None} for object_id in object_ids})


def close_place(root, object_id: int, is_closed: bool) -> None:
    """Close what a removed object hid, or leave it as it was trained."""
    _show_edit(root, {object_id: {"fill": is_closed or None}})


def reset_colours(root, object_ids: Iterable[int]) -> None:
    """Give objects their own colours back."""
    _show_edit(root, {object_id: {"recolour": None} for object_id in object_ids})


def _show_edit(root, changes: dict[int, dict]) -> None:
    """Write edits to objects.json and show them, where that needs no splats from the folder."""
    _require_object_mode(root)
    flush()
    folder = scene.folder_of(root)
    edit_objects(Reconstruction(folder).objects, changes)
    try:
        scene.show_edits(root, scene.Objects.read(folder))
    finally:
        fill(root)
    _tell(root)


def _tell(root) -> None:
    for call in after_edits:
        call(root)


def flush() -> None:
    """Write new colours that wait for it."""
    waiting = set(_unwritten)
    if not waiting:
        return
    _unwritten.clear()
    for root in [root for root in bpy.data.collections if scene.kind_of(root) == "reconstruction"]:
        items = [item for item in root.objectgs.objects if (root.session_uid, from_stored(item.object_id)) in waiting]
        if items:
            _write_colours(root, items)


def _write_colours(root, items) -> None:
    changes = {from_stored(item.object_id): {"recolour": recolour_of(item).stored()} for item in items}
    try:
        edit_objects(Reconstruction(scene.folder_of(root)).objects, changes)
    except (InputError, OSError) as error:
        for item in items:
            _restore(item)
            scene.recolour(root, from_stored(item.object_id), recolour_of(item))
        messages.show(f"Colors were not changed: {messages.sentence(error)}", "ERROR")
        return
    for item in items:
        _remember(item)


def recolour_of(item) -> Recolour:
    """What a row's sliders ask for."""
    values = {name: round(getattr(item, name), DIGITS) for name in SLIDERS}
    values |= {name: tuple(round(channel, DIGITS) for channel in getattr(item, name)) for name in COLOURS}
    return Recolour(**values, middle=round(item.middle, DIGITS)) if item.middle else Recolour(**values)


def _rounded(recolour: Recolour | None) -> Recolour:
    """A stored one as sliders hold it."""
    if recolour is None:
        return Recolour()
    values = {name: round(getattr(recolour, name), DIGITS) for name in (*SLIDERS, "middle")}
    return Recolour(**values, **{name: tuple(round(channel, DIGITS) for channel in getattr(recolour, name))
                                 for name in COLOURS})


def _set_sliders(item, recolour: Recolour | None) -> None:
    wanted = recolour or Recolour()
    for name in (*SLIDERS, *COLOURS):
        setattr(item, name, getattr(wanted, name))
    item.middle = wanted.middle if recolour is not None else 0.0


def chosen_ids(context, root) -> list[int]:
    """IDs of the objects selected in the viewport, or that of the active row; merged ones as what they are shown as."""
    ids = selection.selected_ids(context, root)
    item = active_item(root)
    if not ids and item is not None:
        ids = [from_stored(item.object_id)]
    return list(dict.fromkeys(shown_as(root, object_id) for object_id in ids if object_id))


def item_of(root, object_id: int):
    """The row of an ID, or None."""
    return next((item for item in root.objectgs.objects if from_stored(item.object_id) == object_id), None)


def shown_item(root):
    """The row of what the active row is shown as: itself, or what it was merged into; None where there are no rows."""
    item = active_item(root)
    return item and item_of(root, shown_as(root, from_stored(item.object_id)))


def shown_as(root, object_id: int) -> int:
    """The ID of the object whose collection shows `object_id`: itself, or what it was merged into."""
    rows = [SceneObject(from_stored(item.object_id), item.name, (0, 0, 0), 0,
                        from_stored(item.merged_into) if item.is_merged else None) for item in root.objectgs.objects]
    return merged(rows).get(object_id, object_id)


def scenes_of(root):
    """The scenes that hold the reconstruction."""
    return [owner for owner in bpy.data.scenes if root in owner.collection.children_recursive]


def active_item(root):
    """The active row, or None where there are no rows."""
    properties = root.objectgs
    count = len(properties.objects)
    return properties.objects[min(max(properties.active_object, 0), count - 1)] if count else None


def _rgb(item) -> list[int]:
    return [round(255 * channel) for channel in item.colour]


# Update callbacks of the rows' properties.


def name_changed(item, _context) -> None:
    if _filling:
        return
    name = " ".join(item.name.split())
    if not name:
        _restore(item)  # An empty name is no name.
        return
    with without_callbacks():
        item.name = name
    _row_changed(item, name=name)


def colour_changed(item, _context) -> None:
    _row_changed(item, colour=_rgb(item))


def chosen_changed(item, _context) -> None:
    _row_changed(item, left_out=None if item.chosen else True)


def recolour_changed(item, _context) -> None:
    """A slider was moved: shown at once, written a little later."""
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
    scene.recolour(root, object_id, recolour_of(item))
    _unwritten.add((root.session_uid, object_id))
    if bpy.app.background:
        flush()
        return
    if bpy.app.timers.is_registered(_flush_later):
        bpy.app.timers.unregister(_flush_later)
    bpy.app.timers.register(_flush_later, first_interval=WRITE_AFTER)


@writing.allowed
def _flush_later() -> None:
    flush()


def _row_changed(item, **changes) -> None:
    """One row was edited by the user; it is as before where that cannot be stored. A callback must not raise."""
    if _filling:
        return
    root = item.id_data
    folder = scene.folder_of(root)
    try:
        _require_object_mode(root)
        flush()
        edit_objects(Reconstruction(folder).objects, {from_stored(item.object_id): changes})
    except (InputError, OSError) as error:
        _restore(item)
        messages.show(f"{item.name} was not changed: {messages.sentence(error)}", "ERROR")
        return
    _remember(item)
    try:
        for owner in scenes_of(root)[:1]:
            scene.show_objects(root, folder, owner)
        _tell(root)
    except (InputError, OSError) as error:
        messages.show(messages.sentence(error), "ERROR")


def _require_object_mode(root) -> None:
    """Raise InputError before anything is changed that could then not be shown."""
    scene.require_object_mode(part for part in root.all_objects if scene.kind_of(part) is not None)


def _remember(item) -> None:
    """Keep what a refused edit goes back to."""
    item.stored = json.dumps([item.name, list(item.colour), item.chosen, recolour_of(item).stored()])


def _restore(item) -> None:
    """Take back an edit that was refused."""
    if item.stored:
        with without_callbacks():
            item.name, item.colour, item.chosen, *recolour = json.loads(item.stored)
            if recolour:  # Files of older versions have none.
                _set_sliders(item, Recolour.of(recolour[0]) if recolour[0] else None)


def active_changed(properties, context) -> None:
    """A click in the list selects the object in the viewport."""
    if _filling:
        return
    root = properties.id_data
    item = active_item(root)
    if item is not None:
        selection.select_object(context, root, shown_as(root, from_stored(item.object_id)))

