# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats drawn as they are, and in which colours."""

import bpy

from .. import drawing
from ..job_display import write
from .tab import WithReconstruction


class DrawingPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_drawing"
    bl_label = "Draw Splats"

    def draw_header(self, context):
        self.layout.prop(context.scene.objectgs, "draw_splats", text="")

    def draw(self, context):
        if drawing.trouble() is not None:
            write(self.layout, drawing.trouble(), "ERROR")
        column = self.layout.column()
        column.active = context.scene.objectgs.draw_splats
        column.label(text="Colors")
        column.row().prop(context.scene.objectgs, "splat_colours", expand=True)
