# SPDX-License-Identifier: GPL-3.0-or-later
"""Import of captures, and the folder of the reconstruction."""

from __future__ import annotations

import bpy

from .. import scene
from ..environment import locations
from ..process import jobs
from ..running import background
from ..running.job_display import write
from ..state.folder_state import folder_state
from .tab import Tab, draw_job


class CapturePanel(Tab, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_capture"
    bl_label = "ObjectGS"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        if locations.backend_python() is None:
            box = layout.box()
            write(box, "The compute backend is not set up yet.", "INFO")
            opens = box.operator("preferences.addon_show", text="Open Preferences", icon="PREFERENCES")
            opens.module = locations.PACKAGE
        column = layout.column(align=True)
        column.operator("objectgs.import_capture", icon="IMPORT")
        column.operator("objectgs.open_reconstruction", icon="FILE_FOLDER")
        column.operator("objectgs.make_demo", icon="MESH_MONKEY")
        for index, job in enumerate(background.queue.jobs):
            if job.kind in ("import", "demo") and (not job.is_finished or job.state is jobs.State.FAILED):
                draw_job(layout, job, index)
        active = context.scene.objectgs.active
        if active is not None:
            layout.prop(context.scene.objectgs, "active", text="")
            _draw_folder(layout, active)


def _draw_folder(layout: bpy.types.UILayout, root: bpy.types.Collection) -> None:
    """Draw the reconstruction's folder, or a message if it is missing."""
    folder = scene.folder_of(root)
    if not folder_state(folder).exists:
        write(
            layout,
            f"The folder {folder} is missing. The contents of this file are kept; to assign objects or train, put the "
            "folder back or import the capture again.",
            "ERROR",
        )
        return
    row = layout.row(align=True)
    row.label(text=folder.name, icon="FILE_FOLDER")
    row.operator("wm.path_open", text="", icon="FILEBROWSER").filepath = str(folder)
    row.operator("objectgs.show_result", text="", icon="FILE_REFRESH")
