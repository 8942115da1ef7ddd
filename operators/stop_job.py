# SPDX-License-Identifier: GPL-3.0-or-later
"""Stop a job, and clear those that are over."""

import bpy
from bpy.props import IntProperty

from ..objectgs_addon import running


class StopJob(bpy.types.Operator):
    bl_idname = "objectgs.stop_job"
    bl_label = "Stop"
    bl_description = "Stop this job. What it has made is kept, and the same step goes on from there later"

    index: IntProperty(name="Job", default=-1, description="Place in the queue; -1: the running one",
                       options={"SKIP_SAVE"})

    @classmethod
    def poll(cls, _context):
        if any(not job.is_finished for job in running.queue.jobs):
            return True
        cls.poll_message_set("No job is running")
        return False

    def execute(self, _context):
        jobs = running.queue.jobs
        job = jobs[self.index] if 0 <= self.index < len(jobs) else running.queue.running
        if job is None or job.is_finished:
            self.report({"WARNING"}, "This job is over already")
            return {"CANCELLED"}
        job.stop()
        running.redraw()
        return {"FINISHED"}


class ClearJobs(bpy.types.Operator):
    bl_idname = "objectgs.clear_jobs"
    bl_label = "Clear Finished Jobs"
    bl_description = "Take the jobs that are over from the list"

    def execute(self, _context):
        running.queue.clear_finished()
        running.redraw()
        return {"FINISHED"}


CLASSES = (StopJob, ClearJobs)
