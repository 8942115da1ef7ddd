# SPDX-License-Identifier: GPL-3.0-or-later
"""The list of objects."""

import bpy

from ..job_display import write
from ..object_list import describe
from .tab import WithReconstruction


class ObjectsPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_objects"
    bl_label = "Objects"

    def draw(self, context):
        layout = self.layout
        properties = context.scene.objectgs.active.objectgs
        if not properties.objects:
            write(layout, "Vote to find the objects.", "INFO")
            return
        row = layout.row()
        row.template_list("OBJECTGS_UL_objects", "", properties, "objects", properties, "active_object", rows=8)
        column = row.column(align=True)
        column.operator("objectgs.select_object", text="", icon="RESTRICT_SELECT_OFF")
        column.operator("objectgs.find_objects", text="", icon="VIEWZOOM")
        column.operator("objectgs.solo_object", text="", icon="SOLO_ON")
        column.separator()
        column.operator("objectgs.merge_objects", text="", icon="AUTOMERGE_ON")
        column.operator("objectgs.split_objects", text="", icon="UNLINKED")
        column.separator()
        column.operator_menu_enum("objectgs.choose_objects", "which", text="", icon="CHECKBOX_HLT")
        if 0 <= properties.active_object < len(properties.objects):
            write(layout, describe(properties.objects[properties.active_object], properties))
        left_out = sum(not item.chosen for item in properties.objects)
        if left_out:
            layout.label(text=f"{left_out} of {len(properties.objects)} are left out when training")
        layout.prop(context.scene.objectgs, "select_whole")
