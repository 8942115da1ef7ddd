# SPDX-License-Identifier: GPL-3.0-or-later
"""How a job looks in panels, preferences and the status bar."""

import textwrap

import bpy

from .jobs import Job, State

CHARACTER = 6.6
"""Width of a character in pixels, at Blender's usual size."""
AROUND = 60.0
"""Pixels of a line that borders and an icon take."""


def duration(seconds: float) -> str:
    """134.2 -> 2:14; 7384 -> 2:03:04."""
    whole = max(0, round(seconds))
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours}:{minutes:02}:{whole % 60:02}" if hours else f"{minutes}:{whole % 60:02}"


def summary(job: Job) -> str:
    """The job in a few words: how far, how long still."""
    if job.state is State.WAITING:
        return f"{job.title}: waiting"
    if job.state is State.PAUSED:
        return f"{job.title}: paused at {100 * job.progress:.0f} %"
    if job.state is State.STOPPING:
        return f"{job.title}: saving and stopping"
    left = f", {duration(job.seconds_left)} left" if job.seconds_left is not None else ""
    return f"{job.title}: {100 * job.progress:.0f} %{left}"


def draw_running(layout, job: Job, index: int) -> None:
    """Progress, buttons and figures of a job that is not over."""
    row = layout.row(align=True)
    if job.state is State.WAITING:
        row.label(text=summary(job), icon="TIME")
    else:
        left = f"{duration(job.seconds_left)} left" if job.seconds_left is not None else ""
        text = {State.PAUSED: "Paused", State.STOPPING: "Saving and stopping"}.get(job.state, left)
        row.progress(factor=job.progress, text=f"{100 * job.progress:.0f} %   {text}")
    if job.can_pause:
        row.operator("objectgs.pause_job", text="", icon="PAUSE")
    if job.state is State.PAUSED:
        row.operator("objectgs.resume_job", text="", icon="PLAY")
    if job.state is not State.STOPPING:
        row.operator("objectgs.stop_job", text="", icon="X").index = index
    if job.message and job.state is not State.WAITING:
        write(layout, f"{job.title}: {job.message}")
    draw_figures(layout, job)


def draw_figures(layout, job: Job) -> None:
    """How good the training is on the photos that it does not see, and how large."""
    figures = []
    if job.psnr is not None:
        figures.append(f"PSNR {job.psnr:.1f} dB")
    if job.miou is not None:
        figures.append(f"mIoU {job.miou:.3f}")
    if job.splats:
        figures.append(f"{job.splats:,} splats")
    if figures:
        write(layout, "   ".join(figures))


def draw_over(layout, job: Job) -> None:
    """How a job ended."""
    if job.state is State.FAILED:
        write(layout, f"{job.title} failed. {job.error}", "ERROR")
    elif job.state is State.STOPPED:
        write(layout, f"{job.title}: stopped. {job.message}", "INFO")
    else:
        write(layout, f"{job.title}: done", "CHECKMARK")
        draw_figures(layout, job)
    for sentence in job.warnings[:3]:
        write(layout, sentence, "ERROR")


def write(layout, text: str, icon: str = "NONE") -> None:
    """`text` in as many lines as it needs in the region that is being drawn."""
    scale = bpy.context.preferences.system.ui_scale
    width = max(20, int((bpy.context.region.width / scale - AROUND) / CHARACTER))
    column = layout.column(align=True)
    for line in textwrap.wrap(text, width):
        column.label(text=line, icon=icon)
        icon = icon if icon == "NONE" else "BLANK1"
