# SPDX-License-Identifier: GPL-3.0-or-later
"""The menu of the objects that single splats can be assigned to."""

from __future__ import annotations

import bpy

from ... import scene


class AssignMenu(bpy.types.Menu):
    bl_idname = "OBJECTGS_MT_assign_splats"
    bl_label = "Assign to"
    bl_description = "Move the selected splats to another object"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        for item in context.scene.objectgs.active.objectgs.objects:
            if item.chosen and not item.is_merged and not item.removed:
                layout.operator("objectgs.assign_splats", text=item.name).object = str(
                    scene.from_stored(item.object_id)
                )
        layout.separator()
        layout.operator("objectgs.assign_splats", text="No Object").object = "0"
