# SPDX-License-Identifier: GPL-3.0-or-later
"""Merge IDs that are one object, and split them again. The masks and the training stay as they are."""

import bpy
from bpy.props import EnumProperty

from ..backend.protocol import InputError
from ..objectgs_addon import messages, object_edits, selection
from . import need

_choices = []
"""Blender needs the strings of a dynamic enum kept alive."""


def _targets(_operator, context):
    global _choices
    root = need.active_root(context)
    _choices = [(str(object_edits.from_stored(item.object_id)), item.name, "")
                for item in root.objectgs.objects if not item.is_merged] if root else []
    return _choices


def _sources(context) -> list[int]:
    """What is to be merged: the objects selected in the viewport if there are several, else the active row's."""
    root = need.active_root(context)
    ids = [object_id for object_id in selection.selected_ids(context, root) if object_id]
    return ids if len(ids) > 1 else [object_edits.from_stored(object_edits.active_item(root).object_id)]


class MergeObjects(bpy.types.Operator):
    bl_idname = "objectgs.merge_objects"
    bl_label = "Merge Objects"
    bl_description = ("Show the objects selected in the viewport, or the active one of the list, as a part of another "
                      "object. Nothing is lost: Split takes it back")
    bl_options = {"REGISTER", "UNDO"}

    into: EnumProperty(name="Into", items=_targets, description="The object that the others become parts of")

    @classmethod
    def poll(cls, context):
        if not need.objects(cls, context) or not need.idle(cls, context):
            return False
        if len(need.active_root(context).objectgs.objects) > 1:
            return True
        cls.poll_message_set("There is only one object")
        return False

    def invoke(self, context, _event):
        sources = _sources(context)
        targets = [choice[0] for choice in _targets(self, context)]
        wanted = sources[-1:] if len(sources) > 1 else [int(t) for t in targets if int(t) != sources[0]]
        if wanted and str(wanted[0]) in targets:
            self.into = str(wanted[0])
        return context.window_manager.invoke_props_dialog(self)

    def draw(self, context):
        items = {object_edits.from_stored(item.object_id): item.name
                 for item in need.active_root(context).objectgs.objects}
        names = [items.get(object_id, "?") for object_id in _sources(context) if str(object_id) != self.into]
        self.layout.label(text=f"Merge {', '.join(names) or 'nothing'}")
        self.layout.prop(self, "into")

    def execute(self, context):
        root = need.active_root(context)
        sources = [object_id for object_id in _sources(context) if str(object_id) != self.into]
        if not sources:
            self.report({"ERROR"}, "Choose another object to merge into")
            return {"CANCELLED"}
        try:
            object_edits.merge(root, sources, int(self.into))
        except (InputError, OSError) as error:
            self.report({"ERROR"}, messages.sentence(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class SplitObjects(bpy.types.Operator):
    bl_idname = "objectgs.split_objects"
    bl_label = "Split Back"
    bl_description = "Take back what was merged into the active object of the list, or where it was merged into"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if not need.objects(cls, context) or not need.idle(cls, context):
            return False
        root = need.active_root(context)
        item = object_edits.active_item(root)
        if item is not None and (item.is_merged or any(
                other.is_merged and other.merged_into == item.object_id for other in root.objectgs.objects)):
            return True
        cls.poll_message_set("The active object was not merged with another")
        return False

    def execute(self, context):
        root = need.active_root(context)
        try:
            object_edits.split(root, object_edits.from_stored(object_edits.active_item(root).object_id))
        except (InputError, OSError) as error:
            self.report({"ERROR"}, messages.sentence(error))
            return {"CANCELLED"}
        return {"FINISHED"}


CLASSES = (MergeObjects, SplitObjects)
