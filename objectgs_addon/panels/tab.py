# SPDX-License-Identifier: GPL-3.0-or-later
"""Shared parts of the panels: their tab, and a job with its progress."""

from __future__ import annotations

import bpy

from ..process.jobs import Job, State
from ..running import background
from ..running.job_display import draw_over, draw_running, write
from ..state import folder_trust
from ..state.next_step import can_mark, has_masks, is_capture_gone, must_use_masks


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
    state = folder_trust.state_of(root)
    if not folder_trust.is_accepted(root):
        text = "Objects are listed once the folder is used."
    elif state.trained and must_use_masks(state):
        text = "Clean Up Labels gives the splats the objects of the masks."
    elif has_masks(state):
        text = "Assign Objects finds the objects by the masks."
    elif is_capture_gone(state):
        text = "Whether the capture has masks shows once its folder is found."
    elif state.trained and can_mark(state):
        text = "Objects are listed once they are marked and separated."
    else:
        text = (
            "The capture has no masks, so it trains as one scene. Draw over its objects after the training, or press "
            "Import Masks for masks of another program or of a segmentation model."
        )
    write(layout, text, "INFO")


def draw_job_of(layout: bpy.types.UILayout, job: Job) -> None:
    """Draw a reconstruction's job in the panel of its operator; that a job has failed is a message of its own."""
    if job.is_finished and job.state is not State.FAILED:
        draw_over(layout, job)
    elif not job.is_finished:
        draw_job(layout, job, background.queue.jobs.index(job))


def draw_job(layout: bpy.types.UILayout, job: Job, index: int, brief: bool = False) -> None:
    """Draw a job of the queue in a box; brief: where another panel says what it does."""
    box = layout.box()
    if job.is_finished:
        draw_over(box, job)
    else:
        draw_running(box, job, index, background.queue.running, brief)
