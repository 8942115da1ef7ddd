# SPDX-License-Identifier: GPL-3.0-or-later
"""Pause and resume the running job."""

import bpy

from ...objectgs_addon.process.jobs import State
from ...objectgs_addon.running import background


class PauseJob(bpy.types.Operator):
    bl_idname = "objectgs.pause_job"
    bl_label = "Pause"
    bl_description = "Save and pause the running job"

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        job = background.queue.running
        if job is not None and job.can_pause:
            return True
        cls.poll_message_set("Nothing that can be paused is running")
        return False

    def execute(self, _context: bpy.types.Context) -> set[str]:
        background.queue.running.pause()
        background.redraw()
        return {"FINISHED"}


class ResumeJob(bpy.types.Operator):
    bl_idname = "objectgs.resume_job"
    bl_label = "Resume"
    bl_description = "Resume the paused job"

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        job = background.queue.running
        if job is not None and job.state is State.PAUSED:
            return True
        cls.poll_message_set("No job is paused")
        return False

    def execute(self, _context: bpy.types.Context) -> set[str]:
        background.queue.running.resume()
        background.redraw()
        return {"FINISHED"}


CLASSES = (PauseJob, ResumeJob)
