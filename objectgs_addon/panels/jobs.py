# SPDX-License-Identifier: GPL-3.0-or-later
"""All running and waiting jobs, and the line in the status bar."""

from __future__ import annotations

import textwrap
from typing import Any

import bpy

from ..blender import messages
from ..running import background
from ..running.job_display import summary
from .tab import Tab, draw_job

_LONGEST = 80
"""Number of characters of a message in the status bar; the ObjectGS tab shows all of it."""


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
    """Draw the latest message, and the running job with its time left and a button to stop it."""
    message = messages.latest()
    if message is not None:
        row = bar.layout.row(align=True)
        row.label(text=textwrap.shorten(message.text, _LONGEST, placeholder="..."), icon=message.kind)
        row.operator("objectgs.dismiss_message", text="", icon="X", emboss=False)
    job = background.queue.running
    if job is not None:
        row = bar.layout.row(align=True)
        row.label(text=f"ObjectGS  {summary(job)}", icon="TIME")
        row.operator("objectgs.stop_job", text="", icon="X", emboss=False)
