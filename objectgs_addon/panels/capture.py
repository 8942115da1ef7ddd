# SPDX-License-Identifier: GPL-3.0-or-later
"""Import of captures, and the folder of the reconstruction."""

from __future__ import annotations

from pathlib import Path

import bpy

from .. import scene
from ..environment import locations
from ..process import jobs
from ..running import background
from ..running.job_display import write
from ..state import folder_trust
from ..state.folder_state import folder_state
from .preferences import draw_online_access
from .tab import Tab, draw_job


class CapturePanel(Tab, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_capture"
    bl_label = "ObjectGS"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        if locations.backend_python() is None:
            box = layout.box()
            write(box, "The compute backend is not set up yet.", "INFO")
            draw_online_access(box)
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
    """Draw the reconstruction's folder, a message if it is missing, or the question whether to use it."""
    if folder_trust.is_in_question(root):
        _draw_question(layout, folder_trust.offered(root))
        return
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


def _draw_question(layout: bpy.types.UILayout, folder: Path) -> None:
    """Ask whether to use the folder of a .blend that comes from elsewhere or was moved."""
    box = layout.box()
    write(box, "This file comes from elsewhere or was moved. Is this its reconstruction folder?", "QUESTION")
    write(box, str(folder))
    text = "Nothing is read, written or started there until you use it. Edits are kept in this file until then."
    column = box.column()
    column.active = False
    write(column, text)
    column = box.column(align=True)
    column.operator("objectgs.use_folder", icon="CHECKMARK").folder = str(folder)
    column.operator("objectgs.open_reconstruction", text="Choose Another...", icon="FILE_FOLDER").instead = True
