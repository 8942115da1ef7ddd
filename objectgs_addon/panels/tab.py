# SPDX-License-Identifier: GPL-3.0-or-later
"""Shared parts of the panels: their tab, and a job with its progress."""

from __future__ import annotations

import bpy

from ..process.jobs import Job
from ..running import background
from ..running.job_display import draw_over, draw_running, write
from ..state import folder_trust


class Tab:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "ObjectGS"


class WithReconstruction(Tab):
    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.scene.objectgs.active is not None


def draw_without_objects(layout: bpy.types.UILayout, root: bpy.types.Collection) -> None:
    """Say how an empty list of objects is filled."""
    accepted = folder_trust.is_accepted(root)
    text = "Use Assign Objects to find the objects." if accepted else "Objects are listed once the folder is used."
    write(layout, text, "INFO")


def draw_job_of(layout: bpy.types.UILayout, job: Job) -> None:
    """Draw a reconstruction's job in the panel of its operator."""
    if job.is_finished:
        draw_over(layout, job)
    else:
        draw_job(layout, job, background.queue.jobs.index(job))


def draw_job(layout: bpy.types.UILayout, job: Job, index: int) -> None:
    """Draw a job of the queue in a box."""
    box = layout.box()
    if job.is_finished:
        draw_over(box, job)
    else:
        draw_running(box, job, index)
