# SPDX-License-Identifier: GPL-3.0-or-later
"""Run a failed job again."""

import bpy
from bpy.props import IntProperty

from ...objectgs_addon.blender import messages
from ...objectgs_addon.environment import locations
from ...objectgs_addon.running import background


class RetryJob(bpy.types.Operator):
    bl_idname = "objectgs.retry_job"
    bl_label = "Try Again"
    bl_description = "Run this job again; it continues from what it has saved"
    bl_options = {"INTERNAL"}

    number: IntProperty(name="Job", description="Number of the failed or stopped job", options={"SKIP_SAVE"})

    def execute(self, context: bpy.types.Context) -> set[str]:
        job = background.ended_job(self.number)
        if job is None:
            self.report({"WARNING"}, "This job is no longer in the list")
            return {"CANCELLED"}
        if job.folder is not None and background.busy(job.folder):
            self.report({"WARNING"}, "Another job is using this reconstruction; wait for it to finish or stop it")
            return {"CANCELLED"}
        messages.dismiss()
        return background.submit(job.again(locations.backend_python()), context.scene, self.report)


CLASSES = (RetryJob,)
