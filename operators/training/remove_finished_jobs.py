# SPDX-License-Identifier: GPL-3.0-or-later
"""Remove finished jobs from the list."""

import bpy

from ...objectgs_addon.running import background


class RemoveFinishedJobs(bpy.types.Operator):
    bl_idname = "objectgs.remove_finished_jobs"
    bl_label = "Remove Finished Jobs"
    bl_description = "Remove the jobs that have ended from the list"

    def execute(self, _context: bpy.types.Context) -> set[str]:
        background.queue.remove_finished()
        background.redraw()
        return {"FINISHED"}


CLASSES = (RemoveFinishedJobs,)
