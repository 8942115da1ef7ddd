# SPDX-License-Identifier: GPL-3.0-or-later
"""Select the object of the active row."""

import bpy
from bpy.props import BoolProperty

from ..objectgs_addon import object_edits, selection
from . import need


class SelectObject(bpy.types.Operator):
    bl_idname = "objectgs.select_object"
    bl_label = "Select Object"
    bl_description = "Select the splats and the mesh of the object that is active in the list"
    bl_options = {"REGISTER", "UNDO"}

    extend: BoolProperty(name="Extend", description="Keep what is selected already")

    @classmethod
    def poll(cls, context):
        return need.objects(cls, context)

    def execute(self, context):
        root = need.active_root(context)
        item = object_edits.active_item(root)
        object_id = object_edits.shown_as(root, object_edits.from_stored(item.object_id))
        if not selection.select_object(context, root, object_id, self.extend):
            self.report({"WARNING"}, f"{item.name} has nothing to select yet, or is hidden")
            return {"CANCELLED"}
        return {"FINISHED"}


CLASSES = (SelectObject,)
