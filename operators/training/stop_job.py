# SPDX-License-Identifier: GPL-3.0-or-later
"""Stop a job."""

import bpy
from bpy.props import IntProperty

from ...objectgs_addon.running import background


class StopJob(bpy.types.Operator):
    bl_idname = "objectgs.stop_job"
    bl_label = "Stop"
    bl_description = (
        "Stop this job. Training, poses, meshes and film frames go on from there later; other work starts anew. "
        "Press again to end it by force, without saving"
    )

    index: IntProperty(
        name="Job", default=-1, description="Index in the queue; -1: the running job", options={"SKIP_SAVE"}
    )

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        if any(not job.is_finished for job in background.queue.jobs):
            return True
        cls.poll_message_set("No job is running")
        return False

    def execute(self, _context: bpy.types.Context) -> set[str]:
        jobs = background.queue.jobs
        job = jobs[self.index] if 0 <= self.index < len(jobs) else background.queue.running
        if job is None or job.is_finished:
            self.report({"WARNING"}, "This job has already ended")
            return {"CANCELLED"}
        job.stop()
        background.redraw()
        return {"FINISHED"}


CLASSES = (StopJob,)
