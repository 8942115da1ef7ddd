# SPDX-License-Identifier: GPL-3.0-or-later
"""Select the active object of the list."""

import bpy
from bpy.props import BoolProperty

from ...objectgs_addon import scene
from ...objectgs_addon.picking import selection
from ...objectgs_addon.state import object_list
from ..common import need


class SelectObject(bpy.types.Operator):
    bl_idname = "objectgs.select_object"
    bl_label = "Select Object"
    bl_description = "Select the splats and the mesh of the active object of the list"
    bl_options = {"REGISTER", "UNDO"}

    extend: BoolProperty(name="Extend", description="Keep the current selection")

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.listed_objects(cls, context) and need.object_mode(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        root = need.active_root(context)
        item = object_list.active_item(root)
        object_id = object_list.merge_target(root, scene.from_stored(item.object_id))
        if not selection.select_object(context, root, object_id, self.extend):
            self.report({"WARNING"}, f"{item.name} is hidden or has no splats and no mesh yet")
            return {"CANCELLED"}
        return {"FINISHED"}


CLASSES = (SelectObject,)
