# SPDX-License-Identifier: GPL-3.0-or-later
"""Placement in the scene, and what colours show."""

import bpy

from .tab import WithReconstruction


class DisplayPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_display"
    bl_label = "Placement and Display"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        layout = self.layout
        properties = context.scene.objectgs.active.objectgs
        column = layout.column(align=True)
        column.operator("objectgs.set_ground", icon="ORIENTATION_NORMAL")
        column.operator("objectgs.set_distance", icon="DRIVER_DISTANCE")
        layout.label(text="Color points by")
        layout.row().prop(properties, "colour_by", expand=True)
        layout.label(text="Splats: objects or photo")
        row = layout.row(align=True)
        row.prop_enum(context.space_data.shading, "type", "SOLID", text="Objects")
        row.prop_enum(context.space_data.shading, "type", "MATERIAL", text="Photo")
