# SPDX-License-Identifier: GPL-3.0-or-later
"""Edits of single splats: selection, deletion, other objects, and the crop."""

from __future__ import annotations

import bpy

from ... import scene
from ...running.job_display import write
from ...state import splat_edits
from ..tab import WithReconstruction
from .assign_menu import AssignMenu


class SplatsPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_splats"
    bl_label = "Splats"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout, root = self.layout, context.scene.objectgs.active
        count = splat_edits.count_selected(context, root)
        layout.label(text=f"{count:,} selected", icon="RESTRICT_SELECT_OFF")
        column = layout.column(align=True)
        row = column.row(align=True)
        for text, action in (("All", "SELECT"), ("None", "DESELECT"), ("Invert", "INVERT")):
            row.operator("objectgs.select_all_splats", text=text).action = action
        row = column.row(align=True)
        row.enabled = count > 0
        row.operator("objectgs.grow_splats", text="Grow", icon="ADD")
        row.operator("objectgs.shrink_splats", text="Shrink", icon="REMOVE")
        column = layout.column(align=True)
        column.enabled = count > 0
        column.operator("objectgs.delete_splats", text="Delete", icon="TRASH")
        column.operator("objectgs.separate_splats", text="Separate", icon="ADD")
        column.menu(AssignMenu.bl_idname, icon="FORWARD")
        self._draw_crop(layout, root)
        self._draw_edits(layout, root)

    def _draw_crop(self, layout: bpy.types.UILayout, root: bpy.types.Collection) -> None:
        shown = scene.shown_edits(root)
        column = layout.column(align=True)
        column.operator("objectgs.add_crop_box", icon="MESH_CUBE")
        if scene.crop_box_of(root) is not None:
            column.operator("objectgs.apply_crop", icon="CHECKMARK")
        if shown is not None and shown.cropped:
            column.operator("objectgs.remove_crop", icon="X")

    def _draw_edits(self, layout: bpy.types.UILayout, root: bpy.types.Collection) -> None:
        shown = scene.shown_edits(root)
        if shown is None or not shown.digest:
            return
        words = [
            f"{number:,} {what}"
            for number, what in ((shown.deleted, "deleted"), (shown.assigned, "assigned"))
            if number
        ]
        words += ["cropped"] if shown.cropped else []
        layout.label(text=", ".join(words).capitalize())
        if shown.missing:
            write(layout, f"{shown.missing:,} edits match no splat, as after further training.", "INFO")
        column = layout.column(align=True)
        if shown.deleted:
            column.operator("objectgs.restore_splats", icon="LOOP_BACK")
        column.operator("objectgs.clear_splat_edits", icon="X")
