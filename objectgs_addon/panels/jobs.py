# SPDX-License-Identifier: GPL-3.0-or-later
"""All running and waiting jobs, and the line in the status bar."""

from __future__ import annotations

from typing import Any

import bpy

from ..running import background
from ..running.job_display import summary
from .tab import Tab, draw_job


class JobsPanel(Tab, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_jobs"
    bl_label = "Jobs"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        return bool(background.queue.jobs)

    def draw(self, _context: bpy.types.Context) -> None:
        layout = self.layout
        for index, job in enumerate(background.queue.jobs):
            draw_job(layout, job, index)
        layout.operator("objectgs.remove_finished_jobs", icon="X")


def status_bar(bar: Any, _context: bpy.types.Context) -> None:
    """Draw the running job with its time left and a button to stop it."""
    job = background.queue.running
    if job is not None:
        row = bar.layout.row(align=True)
        row.label(text=f"ObjectGS  {summary(job)}", icon="TIME")
        row.operator("objectgs.stop_job", text="", icon="X", emboss=False)
