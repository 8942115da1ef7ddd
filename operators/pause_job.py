# SPDX-License-Identifier: GPL-3.0-or-later
"""Pause the running job, and let it go on."""

import bpy

from ..objectgs_addon import running
from ..objectgs_addon.jobs import State


class PauseJob(bpy.types.Operator):
    bl_idname = "objectgs.pause_job"
    bl_label = "Pause"
    bl_description = "Let the running job wait; it has saved, and goes on at once when told to"

    @classmethod
    def poll(cls, _context):
        job = running.queue.running
        if job is not None and job.can_pause:
            return True
        cls.poll_message_set("No training is running; only training can be paused")
        return False

    def execute(self, _context):
        running.queue.running.pause()
        running.redraw()
        return {"FINISHED"}


class ResumeJob(bpy.types.Operator):
    bl_idname = "objectgs.resume_job"
    bl_label = "Resume"
    bl_description = "Go on with the job that was paused"

    @classmethod
    def poll(cls, _context):
        job = running.queue.running
        if job is not None and job.state is State.PAUSED:
            return True
        cls.poll_message_set("No job is paused")
        return False

    def execute(self, _context):
        running.queue.running.resume()
        running.redraw()
        return {"FINISHED"}


CLASSES = (PauseJob, ResumeJob)
