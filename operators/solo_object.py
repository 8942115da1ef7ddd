# SPDX-License-Identifier: GPL-3.0-or-later
"""Show one object alone, and all of them again."""

import bpy

from ..objectgs_addon import object_edits, scene, visibility
from . import need


class SoloObject(bpy.types.Operator):
    bl_idname = "objectgs.solo_object"
    bl_label = "Solo"
    bl_description = "Show only the object that is active in the list; once more shows all objects again"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if not need.objects(cls, context):
            return False
        if scene.object_collections(need.active_root(context)):
            return True
        cls.poll_message_set("Objects are shown once they were trained")
        return False

    def execute(self, context):
        root = need.active_root(context)
        item = object_edits.active_item(root)
        object_id = object_edits.shown_as(root, object_edits.from_stored(item.object_id))
        if not visibility.toggle_solo(context.view_layer, root, object_id):
            self.report({"WARNING"}, f"{item.name} has no splats to show")
            return {"CANCELLED"}
        return {"FINISHED"}


CLASSES = (SoloObject,)
