# SPDX-License-Identifier: GPL-3.0-or-later
"""Extraction and display of meshes."""

from __future__ import annotations

import bpy

from ...backend.shared.reconstruction.lock import lock_holder
from .. import scene
from ..running import background
from ..running.job_display import write
from ..state import folder_trust
from .tab import WithReconstruction, draw_job_of


class MeshesPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_meshes"
    bl_label = "Meshes"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        root = context.scene.objectgs.active
        properties = root.objectgs
        folder = scene.folder_of(root)
        state = folder_trust.state_of(root)
        job = background.job_of(root)
        column = layout.column()
        column.enabled = not background.is_busy(root)
        column.operator("objectgs.extract_meshes", icon="MESH_DATA")
        column.row().prop(properties, "mesh_objects", expand=True)
        column.use_property_split = True
        column.prop(properties, "mesh_faces")
        column.prop(properties, "texture_size")
        column.prop(properties, "mesh_closed")
        column.prop(properties, "mesh_scene")
        if job is not None and job.kind == "mesh":
            draw_job_of(layout, job)
        elif state.waiting_meshes and lock_holder(folder) is None:
            count = state.waiting_meshes
            write(
                layout,
                f"Meshing was interrupted, and {count} mesh{'es are' if count > 1 else ' is'} missing. "
                "Extract Meshes continues it.",
                "INFO",
            )
        # The mesh of the whole scene is only updated with its option, or where it is the only one.
        stale = state.stale_meshes + (state.stale_scene and (properties.mesh_scene or not properties.objects))
        if stale and not background.is_busy(root):
            write(
                layout,
                f"{stale} of {state.meshes} meshes were made at another step of the training. "
                "Extract Meshes updates them.",
                "INFO",
            )
        if state.meshes and not background.is_busy(root) and scene.meshes_are_newer(root):
            write(layout, "The meshes in the folder differ from those shown.", "INFO")
            layout.operator("objectgs.show_result", icon="FILE_REFRESH")
        if not scene.has_shown_meshes(root):
            return
        layout.label(text="Show")
        layout.row().prop(properties, "shown", expand=True)
        space = context.space_data
        if properties.shown != "splats" and space is not None and space.shading.type == "SOLID":
            write(layout, "Solid mode shows no textures; choose Material Preview in the viewport's header.", "INFO")
        layout.label(text="Shading")
        layout.row().prop(properties, "mesh_shading", expand=True)
        for mesh in scene.scene_meshes(root):
            row = layout.row(align=True)
            row.label(text=mesh.name, icon="OUTLINER_OB_MESH")
            row.prop(mesh, "hide_viewport", text="", emboss=False)
            row.prop(mesh, "hide_render", text="", emboss=False)
