# SPDX-License-Identifier: GPL-3.0-or-later
"""What the panels share: the tab they are in, and a job with its progress."""

from .. import running
from ..job_display import draw_over, draw_running


class Tab:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "ObjectGS"


class WithReconstruction(Tab):
    @classmethod
    def poll(cls, context):
        return context.scene.objectgs.active is not None


def draw_job_of(layout, job) -> None:
    """A reconstruction's job in the panel of what it does."""
    if job.is_finished:
        draw_over(layout, job)
    else:
        draw_job(layout, job, running.queue.jobs.index(job))


def draw_job(layout, job, index: int) -> None:
    """A job of the queue in a box."""
    box = layout.box()
    if job.is_finished:
        draw_over(box, job)
    else:
        draw_running(box, job, index)
