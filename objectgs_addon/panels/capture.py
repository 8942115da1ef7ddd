# SPDX-License-Identifier: GPL-3.0-or-later
"""Where a reconstruction comes from: import, and the folder it is in."""

import bpy

from .. import jobs, locations, running, scene
from ..folder_state import folder_state
from ..job_display import write
from .tab import Tab, draw_job


class CapturePanel(Tab, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_capture"
    bl_label = "ObjectGS"

    def draw(self, context):
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
        for index, job in enumerate(running.queue.jobs):
            if job.kind in ("import", "demo") and (not job.is_finished or job.state is jobs.State.FAILED):
                draw_job(layout, job, index)
        active = context.scene.objectgs.active
        if active is not None:
            layout.prop(context.scene.objectgs, "active", text="")
            _draw_folder(layout, active)


def _draw_folder(layout, root) -> None:
    """Where the reconstruction is, and what is wrong with it."""
    folder = scene.folder_of(root)
    state = folder_state(folder)
    if not state.exists:
        write(layout, f"The folder {folder} is gone. What is in this file stays as it is; to train or vote, put the "
                      "folder back or import the capture again.", "ERROR")
        return
    row = layout.row(align=True)
    row.label(text=folder.name, icon="FILE_FOLDER")
    row.operator("wm.path_open", text="", icon="FILEBROWSER").filepath = str(folder)
    row.operator("objectgs.show_result", text="", icon="FILE_REFRESH")
