# SPDX-License-Identifier: GPL-3.0-or-later
"""Remove finished jobs from the list."""

import bpy

from ...objectgs_addon.running import running


class RemoveFinishedJobs(bpy.types.Operator):
    bl_idname = "objectgs.remove_finished_jobs"
    bl_label = "Remove Finished Jobs"
    bl_description = "Remove the jobs that have ended from the list"

    def execute(self, _context: bpy.types.Context) -> set[str]:
        running.queue.remove_finished()
        running.redraw()
        return {"FINISHED"}


CLASSES = (RemoveFinishedJobs,)
