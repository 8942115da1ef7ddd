# SPDX-License-Identifier: GPL-3.0-or-later
"""Orientation and scale of the reconstruction."""

from __future__ import annotations

import bpy

from .tab import WithReconstruction


class PlacementPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_placement"
    bl_label = "Placement"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, _context: bpy.types.Context) -> None:
        column = self.layout.column(align=True)
        column.operator("objectgs.set_ground", icon="ORIENTATION_NORMAL")
        column.operator("objectgs.set_distance", icon="DRIVER_DISTANCE")
