# SPDX-License-Identifier: GPL-3.0-or-later
"""Hide all objects but one, and show them again."""

import bpy

from ...objectgs_addon import scene
from ...objectgs_addon.state import object_list, visibility
from ..common import need


class SoloObject(bpy.types.Operator):
    bl_idname = "objectgs.solo_object"
    bl_label = "Solo"
    bl_description = "Show only the active object of the list, or all objects again"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not need.listed_objects(cls, context):
            return False
        if scene.object_collections(need.active_root(context)):
            return True
        cls.poll_message_set("No object is shown yet; train first")
        return False

    def execute(self, context: bpy.types.Context) -> set[str]:
        root = need.active_root(context)
        item = object_list.active_item(root)
        object_id = object_list.merge_target(root, scene.from_stored(item.object_id))
        if not visibility.toggle_solo(context.view_layer, root, object_id):
            self.report({"WARNING"}, f"{item.name} has no splats to show")
            return {"CANCELLED"}
        return {"FINISHED"}


CLASSES = (SoloObject,)
