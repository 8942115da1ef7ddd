# SPDX-License-Identifier: GPL-3.0-or-later
"""Queries on the list of objects: rows, chosen objects, counts of splats and faces, color edits, and its state."""

from __future__ import annotations

from typing import Any, NamedTuple

import bpy

from ...backend.shared.color.recolor import Recolor
from ...backend.shared.errors import InputError
from ...backend.shared.reconstruction.folder import Reconstruction
from ...backend.shared.reconstruction.objects import SceneObject, follow_merges, read_objects
from .. import scene
from ..picking import selection
from ..scene import from_stored

SLIDERS = ("amount", "hue", "saturation", "value", "contrast")
COLORS = ("replace", "tint")
DIGITS = 6
"""Decimals of a slider's value, about the precision of Blender's floats."""


def active_item(root: bpy.types.Collection) -> Any:
    """Return the active row, or None if the list is empty."""
    properties = root.objectgs
    count = len(properties.objects)
    return properties.objects[min(max(properties.active_object, 0), count - 1)] if count else None


def item_of(root: bpy.types.Collection, object_id: int) -> Any:
    """Return the row of an object ID, or None."""
    return next((item for item in root.objectgs.objects if from_stored(item.object_id) == object_id), None)


def shown_item(root: bpy.types.Collection) -> Any:
    """Return the active row or the row it is merged into; None if the list is empty."""
    item = active_item(root)
    return item and item_of(root, merge_target(root, from_stored(item.object_id)))


def merge_target(root: bpy.types.Collection, object_id: int) -> int:
    """Return the ID of the object into which `object_id` is merged, or `object_id` itself."""
    return merge_targets(root).get(object_id, object_id)


def merge_targets(root: bpy.types.Collection) -> dict[int, int]:
    """Map the IDs of all rows to those of the objects into which they are merged, or to themselves."""
    into = {
        from_stored(item.object_id): from_stored(item.merged_into) if item.is_merged else None
        for item in root.objectgs.objects
    }
    return follow_merges(into)


def chosen_ids(context: bpy.types.Context, root: bpy.types.Collection) -> list[int]:
    """Return the IDs of the objects selected in the viewport, or else of the active row, with merges resolved."""
    ids = selection.selected_ids(context, root)
    item = active_item(root)
    if not ids and item is not None:
        ids = [from_stored(item.object_id)]
    return list(dict.fromkeys(merge_target(root, object_id) for object_id in ids if object_id))


def require_chosen_ids(context: bpy.types.Context, root: bpy.types.Collection) -> list[int]:
    """Return `chosen_ids`; raise InputError if there are none."""
    ids = chosen_ids(context, root)
    if not ids:
        raise InputError("No object is selected; select one in the viewport or in the list")
    return ids


def scenes_of(root: bpy.types.Collection) -> list[bpy.types.Scene]:
    """Return the scenes that contain the reconstruction."""
    return [owner for owner in bpy.data.scenes if root in owner.collection.children_recursive]


def splat_counts(root: bpy.types.Collection) -> dict[int, int]:
    """Map object IDs to the numbers of splats in their collections, including those of merged objects.

    Splats that are unobserved, deleted or outside of the crop do not count.
    """
    return {
        object_id: sum(
            int((~scene.unobserved_splats(part.data) & ~scene.deleted_splats(part.data)).sum())
            for part in scene.parts_of(collection)
            if scene.kind_of(part) == "splats"
        )
        for object_id, collection in scene.object_collections(root).items()
    }


def face_counts(root: bpy.types.Collection) -> dict[int, int]:
    """Map the IDs of objects with meshes to the numbers of their faces."""
    return {
        object_id: sum(len(mesh.data.polygons) for mesh in meshes)
        for object_id, meshes in scene.object_meshes(root).items()
    }


def recolor_of(item: Any) -> Recolor:
    """Return the color edit set by a row's sliders."""
    values = {name: round(getattr(item, name), DIGITS) for name in SLIDERS}
    values |= {name: tuple(round(channel, DIGITS) for channel in getattr(item, name)) for name in COLORS}
    return Recolor(**values, middle=round(item.middle, DIGITS)) if item.middle else Recolor(**values)


def rounded(recolor: Recolor | None) -> Recolor:
    """Round a stored color edit to the precision of the sliders."""
    if recolor is None:
        return Recolor()
    values = {name: round(getattr(recolor, name), DIGITS) for name in (*SLIDERS, "middle")}
    return Recolor(
        **values, **{name: tuple(round(channel, DIGITS) for channel in getattr(recolor, name)) for name in COLORS}
    )


def restored(root: bpy.types.Collection, object_id: int) -> dict[str, None]:
    """Return the fields of objects.json to reset to restore an object; the hole of one that is moved stays filled."""
    collection = scene.object_collections(root).get(object_id)
    is_moved = collection is not None and scene.is_moved(root, collection)
    return dict.fromkeys(("removed", "floaters") if is_moved else ("removed", "floaters", "fill"))


def rgb_of(item: Any) -> list[int]:
    """Return the color of a row, sRGB 0 .. 255."""
    return [round(255 * channel) for channel in item.color]


def row_of(entry: SceneObject) -> dict[str, Any]:
    """Return the row of an object of objects.json as `state_of` returns those of the list."""
    return {
        "name": entry.name,
        "color": list(entry.color),
        "left_out": entry.left_out or None,
        "merged_into": entry.merged_into,
        "removed": entry.removed or None,
        "floaters": entry.floaters or None,
        "fill": entry.fill or None,
        "cleaned": entry.cleaned or None,
        "recolor": rounded(entry.recolor).stored(),
        "separated": entry.separated or None,
    }


class State(NamedTuple):
    """The list of objects by ID, as fields of objects.json, and where the objects are."""

    rows: dict[int, dict[str, Any]]
    places: dict[int, scene.Places]


def state_of(root: bpy.types.Collection) -> State:
    """Return the present list and places, to be compared with those after an undo."""
    return State(_rows_of(root), scene.places_of(root))


def shows_edits(root: bpy.types.Collection) -> bool:
    """Return whether the list, the places and the duplicates are those that objects.json had at the last sync.

    A missing file or folder has no other edits.

    Raises:
        InputError: objects.json cannot be used.
    """
    path = Reconstruction(scene.folder_of(root)).objects
    if not path.exists():
        return True
    entries = read_objects(path)
    return _rows_of(root) == {entry.id: row_of(entry) for entry in entries} and scene.shows_places(root, entries)


def newer_edits(root: bpy.types.Collection) -> str:
    """Return the message that a reconstruction does not show the edits in its folder."""
    path = Reconstruction(scene.folder_of(root)).objects
    return (
        f"{root.name} does not show the edits in {path}, which exports and films use; use Reload Result to show them."
    )


def _rows_of(root: bpy.types.Collection) -> dict[int, dict[str, Any]]:
    return {
        from_stored(item.object_id): {
            "name": item.name,
            "color": rgb_of(item),
            "left_out": None if item.chosen else True,
            "merged_into": from_stored(item.merged_into) if item.is_merged else None,
            "removed": item.removed or None,
            "floaters": item.floaters or None,
            "fill": item.fill or None,
            "cleaned": item.cleaned or None,
            "recolor": recolor_of(item).stored(),
            "separated": item.separated or None,
        }
        for item in root.objectgs.objects
    }
