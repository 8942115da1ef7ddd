# SPDX-License-Identifier: GPL-3.0-or-later
"""Export of splats and meshes to files of other programs, and to the asset browser."""

from __future__ import annotations

import bpy

from .tab import WithReconstruction


class ExportPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_export"
    bl_label = "Export"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, _context: bpy.types.Context) -> None:
        column = self.layout.column(align=True)
        column.operator("objectgs.export_splats", icon="EXPORT")
        column.operator("objectgs.export_meshes", icon="EXPORT")
        self.layout.operator("objectgs.mark_assets", icon="ASSET_MANAGER")
