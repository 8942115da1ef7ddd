# SPDX-License-Identifier: GPL-3.0-or-later
"""Reset an object's colors or transform to those of the capture."""

import bpy
from bpy.props import EnumProperty

from ...objectgs_addon import scene
from ...objectgs_addon.picking import selection
from ...objectgs_addon.state import object_edits, object_list
from ..common import need
from ..common.reporting import reports_errors


class ResetObject(bpy.types.Operator):
    bl_idname = "objectgs.reset_object"
    bl_label = "Reset"
    bl_description = "Reset the active object of the list to the capture"
    bl_options = {"REGISTER", "UNDO"}

    what: EnumProperty(
        name="What",
        items=[
            ("COLORS", "Colors", "Reset the colors to those of the capture"),
            ("TRANSFORM", "Transform", "Move the object back to where it was captured"),
        ],
    )

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return {
            "COLORS": "Reset the colors of the active object to those of the capture",
            "TRANSFORM": "Move the active object or duplicate back to where it was captured",
        }[properties.what]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.edited(cls, context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root = need.active_root(context)
        item = object_list.shown_item(root)
        object_id = scene.from_stored(item.object_id)
        if self.what == "COLORS":
            object_edits.reset_colors(root, [object_id])
        else:
            object_edits.store_edits(root)  # Earlier changes have an undo step of their own.
            duplicate = selection.active_duplicate(context, root, object_id)
            scene.reset_placement(root, duplicate or scene.object_collections(root)[object_id])
            object_edits.store_edits(root)
            if duplicate is None and item.fill and not item.removed:
                object_edits.fill_hole(root, object_id, False)


CLASSES = (ResetObject,)
