# SPDX-License-Identifier: GPL-3.0-or-later
"""Selection of a reconstruction's objects in the viewport."""

from __future__ import annotations

from typing import Any

import bpy

from .. import drawing, scene


def select_object(context: bpy.types.Context, root: bpy.types.Collection, object_id: int, extend: bool = False) -> bool:
    """Select all visible parts of an object; return False if there are none."""
    collection = scene.object_collections(root).get(object_id)
    return collection is not None and select_collections(context, [collection], extend)


def select_collections(context: bpy.types.Context, collections: Any, extend: bool = False) -> bool:
    """Select all visible parts of objects, and make the last object active.

    Args:
        context: context with the view layer.
        collections: collections of the objects.
        extend: keep the current selection.

    Returns:
        False if there is nothing to select; the selection is then unchanged.
    """
    parts = [parts_to_select(collection) for collection in collections]
    if not any(parts):
        return False
    if not extend:
        select_nothing(context)
    for part in (part for own in parts for part in own):
        part.select_set(True)
    activate(context, next(own for own in reversed(parts) if own))
    return True


def activate(context: bpy.types.Context, parts: list) -> None:
    """Make the parent of an object's parts the active Blender object, or else the first part."""
    parent = (part for part in parts if scene.kind_of(part) == "object_parent")
    context.view_layer.objects.active = next(parent, parts[0])


def parts_to_select(collection: bpy.types.Collection) -> list:
    """Return the selectable parts of an object's collection."""
    return [part for part in scene.parts_of(collection) if selectable(part)]


def select_nothing(context: bpy.types.Context) -> None:
    for selected in context.selected_objects:
        selected.select_set(False)


def selected_ids(context: bpy.types.Context, root: bpy.types.Collection) -> list[int]:
    """Return the IDs of the selected objects, the active one last."""
    parts = scene.only_of(root, context.selected_objects, context.scene)
    if context.active_object in parts:
        parts.remove(context.active_object)
        parts.append(context.active_object)
    ids = (scene.object_id_of(part) for part in reversed(parts))
    return list(dict.fromkeys(object_id for object_id in ids if object_id is not None))[::-1]


def selected_collections(context: bpy.types.Context, root: bpy.types.Collection) -> list:
    """Return the collections of the selected objects and duplicates."""
    parts = scene.only_of(root, context.selected_objects, context.scene)
    collections = drawing.collections_by_part() if parts else {}
    return list(dict.fromkeys(collections[part] for part in parts if part in collections))


def select_shown_parts(view_layer: bpy.types.ViewLayer, root: bpy.types.Collection) -> None:
    """Select the visible parts of objects and duplicates of which any part is selected, such as new meshes."""
    found = drawing.collections_by_part()
    selected = {found[part] for part in view_layer.objects.selected if part in found} & set(root.children_recursive)
    if not selected:
        return
    view_layer.update()
    for collection in selected:
        for part in scene.parts_of(collection):
            if part.visible_get(view_layer=view_layer) and not part.hide_select:
                part.select_set(True, view_layer=view_layer)


def active_duplicate(
    context: bpy.types.Context, root: bpy.types.Collection, object_id: int
) -> bpy.types.Collection | None:
    """Return the collection of an object's duplicate that the active object is of, if it is selected; or None."""
    active = context.active_object
    if active is None or active not in context.selected_objects:
        return None
    copies = scene.duplicates_of(root).get(object_id, [])
    return next((copy for copy in copies if active in set(copy.objects)), None)


def selectable(part: bpy.types.Object) -> bool:
    return part.visible_get() and not part.hide_select
