# SPDX-License-Identifier: GPL-3.0-or-later
"""Selecting the objects of a reconstruction in the viewport."""

from . import scene


def select_object(context, root, object_id: int, extend: bool = False) -> bool:
    """Select everything of an object that the view layer shows; False where there is nothing to select."""
    collection = scene.object_collections(root).get(object_id)
    parts = [part for part in scene.parts_of(collection) if selectable(part)] if collection else []
    if not parts:
        return False
    layer = context.view_layer
    if not extend:
        for selected in context.selected_objects:
            selected.select_set(False)
    for part in parts:
        part.select_set(True)
    active = next((part for part in parts if scene.kind_of(part) == "object_parent"), parts[0])
    layer.objects.active = active
    return True


def selected_ids(context, root) -> list[int]:
    """IDs of the objects that are selected in the viewport, the active one last."""
    ids = []
    parts = list(context.selected_objects)
    if context.active_object in parts:
        parts.remove(context.active_object)
        parts.append(context.active_object)
    for part in parts:
        if scene.root_of(part, context.scene) == root and (object_id := scene.object_id_of(part)) is not None:
            if object_id in ids:
                ids.remove(object_id)
            ids.append(object_id)
    return ids


def selectable(part) -> bool:
    return part.visible_get() and not part.hide_select
