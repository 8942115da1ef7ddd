# SPDX-License-Identifier: GPL-3.0-or-later
"""Selection of whole objects and their list rows when one part is clicked in the viewport or the outliner."""

from __future__ import annotations

from typing import Any

import bpy

from .. import scene
from ..blender import writing
from ..picking.selection import selectable
from . import object_edits, object_list

_owner = object()


@writing.allowed
def _active_changed() -> None:
    """Select the object of the new active part; Blender calls this when the active object changes."""
    context = bpy.context
    part = getattr(context, "active_object", None)
    if part is None or part.mode != "OBJECT" or not part.select_get():
        return
    object_id = scene.object_id_of(part)
    root = scene.root_of(part, context.scene) if object_id is not None else None
    if root is None or scene.is_linked(root):
        return
    context.scene.objectgs.active = root
    shown = object_list.shown_item(root)
    # A row that is merged into this object stays active: a click on it has selected the object.
    if shown is None or scene.from_stored(shown.object_id) != object_id:
        for index, item in enumerate(root.objectgs.objects):
            if scene.from_stored(item.object_id) == object_id:
                with object_edits.without_callbacks():
                    root.objectgs.active_object = index
                break
    if context.scene.objectgs.select_whole:
        whole = scene.collection_of(part)
        for other in scene.parts_of(whole) if whole is not None else ():
            if selectable(other):
                other.select_set(True)


def _subscribe() -> None:
    bpy.msgbus.subscribe_rna(key=(bpy.types.LayerObjects, "active"), owner=_owner, args=(), notify=_active_changed)


@bpy.app.handlers.persistent
def _file_loaded(*_: Any) -> None:
    bpy.msgbus.clear_by_owner(_owner)
    _subscribe()


@bpy.app.handlers.persistent
def _undone(*_: Any) -> None:
    """Extend the selection again, since undo and redo restore only the click itself."""
    _active_changed()


def register() -> None:
    _subscribe()
    bpy.app.handlers.undo_post.append(_undone)
    bpy.app.handlers.redo_post.append(_undone)
    bpy.app.handlers.load_post.append(_file_loaded)


def unregister() -> None:
    bpy.app.handlers.redo_post.remove(_undone)
    bpy.app.handlers.undo_post.remove(_undone)
    bpy.app.handlers.load_post.remove(_file_loaded)
    bpy.msgbus.clear_by_owner(_owner)
