# SPDX-License-Identifier: GPL-3.0-or-later
"""Merge IDs that belong to one object, and split them again. Masks and training are unaffected."""

from typing import Any

import bpy
from bpy.props import EnumProperty

from ...backend.shared.errors import InputError
from ...objectgs_addon import scene
from ...objectgs_addon.picking import selection
from ...objectgs_addon.state import object_edits, object_list
from ..common import need
from ..common.reporting import reports_errors

_choices: list[tuple[str, str, str]] = []
"""Blender requires that the strings of a dynamic enum stay referenced."""


def _targets(_operator: Any, context: bpy.types.Context) -> list[tuple[str, str, str]]:
    global _choices
    root = need.active_root(context)
    items = root.objectgs.objects if root else ()
    ids = [(scene.from_stored(item.object_id), item.name) for item in items if not item.is_merged]
    sources = _sources(context) if ids else []
    # One object is merged into another; of several, each may take the others.
    _choices = [(str(object_id), name, "") for object_id, name in ids if [object_id] != sources]
    return _choices


def _sources(context: bpy.types.Context) -> list[int]:
    """Return the IDs to merge: the objects selected in the viewport if there are several, else the active one."""
    root = need.active_root(context)
    ids = [object_id for object_id in selection.selected_ids(context, root) if object_id]
    return ids if len(ids) > 1 else [scene.from_stored(object_list.active_item(root).object_id)]


class MergeObjects(bpy.types.Operator):
    bl_idname = "objectgs.merge_objects"
    bl_label = "Merge Objects"
    bl_description = (
        "Make the objects selected in the viewport, or the active one of the list, parts of another "
        "object. Split Objects reverts this"
    )
    bl_options = {"REGISTER", "UNDO"}

    into: EnumProperty(name="Into", items=_targets, description="The object that the others become parts of")

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not need.objects(cls, context) or not need.idle(cls, context):
            return False
        if sum(not item.is_merged for item in need.active_root(context).objectgs.objects) > 1:
            return True
        cls.poll_message_set("There is only one object")
        return False

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        sources = _sources(context)
        targets = [choice[0] for choice in _targets(self, context)]
        wanted = sources[-1:] if len(sources) > 1 else [int(target) for target in targets]
        if wanted and str(wanted[0]) in targets:
            self.into = str(wanted[0])
        return context.window_manager.invoke_props_dialog(self)

    def draw(self, context: bpy.types.Context) -> None:
        items = {scene.from_stored(item.object_id): item.name for item in need.active_root(context).objectgs.objects}
        names = [items.get(object_id, "?") for object_id in _sources(context) if str(object_id) != self.into]
        self.layout.label(text=f"Merge {', '.join(names) or 'nothing'}")
        self.layout.prop(self, "into")

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        sources = [object_id for object_id in _sources(context) if str(object_id) != self.into]
        if not sources or not self.into:
            raise InputError("Choose another object to merge into")
        object_edits.merge(need.active_root(context), sources, int(self.into))


class SplitObjects(bpy.types.Operator):
    bl_idname = "objectgs.split_objects"
    bl_label = "Split Objects"
    bl_description = "Undo the merges into the active object of the list, or its own merge into another object"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not need.objects(cls, context) or not need.idle(cls, context):
            return False
        root = need.active_root(context)
        item = object_list.active_item(root)
        if item is not None and (
            item.is_merged
            or any(other.is_merged and other.merged_into == item.object_id for other in root.objectgs.objects)
        ):
            return True
        cls.poll_message_set("The active object is not merged with another; choose the row of one that is")
        return False

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root = need.active_root(context)
        object_edits.split(root, scene.from_stored(object_list.active_item(root).object_id))


CLASSES = (MergeObjects, SplitObjects)
