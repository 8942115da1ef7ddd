# SPDX-License-Identifier: GPL-3.0-or-later
"""Drawing of splats in the viewport, orientation and scale, and the colors of points and splats."""

from __future__ import annotations

import bpy

from .. import drawing
from ..running.job_display import write
from .tab import WithReconstruction


class DisplayPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_display"
    bl_label = "Placement and Display"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        properties = context.scene.objectgs.active.objectgs
        column = layout.column(align=True)
        column.operator("objectgs.set_ground", icon="ORIENTATION_NORMAL")
        column.operator("objectgs.set_distance", icon="DRIVER_DISTANCE")
        layout.label(text="Point Colors")
        layout.row().prop(properties, "color_by", expand=True)
        layout.label(text="Splat Preview Colors")
        row = layout.row(align=True)
        row.prop_enum(context.space_data.shading, "type", "SOLID", text="Object")
        row.prop_enum(context.space_data.shading, "type", "MATERIAL", text="Photo")


class DrawingPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_drawing"
    bl_label = "Draw Splats"

    def draw_header(self, context: bpy.types.Context) -> None:
        self.layout.prop(context.scene.objectgs, "draw_splats", text="")

    def draw(self, context: bpy.types.Context) -> None:
        failure = drawing.failure()
        if failure is not None:
            write(self.layout, failure, "ERROR")
        column = self.layout.column()
        column.active = context.scene.objectgs.draw_splats
        column.label(text="Colors")
        column.row().prop(context.scene.objectgs, "splat_colors", expand=True)
