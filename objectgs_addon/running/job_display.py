# SPDX-License-Identifier: GPL-3.0-or-later
"""Display of jobs in panels, preferences and the status bar."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping

import bpy

from ...backend.shared.durations import time_left
from ...backend.shared.reconstruction.report import MIOU_LABELS, lead_miou
from ..process.jobs import Job, State
from .wording import in_blender

CHARACTER = 6.6
"""Average width of a character in pixels at a UI scale of 1."""
AROUND = 60.0
"""Width of borders and icon in pixels at a UI scale of 1."""

_BUTTON = 45.0
"""Width in pixels of a button beside a text at a UI scale of 1."""
_WARNINGS = 2
"""Number of warnings of a running job that are drawn, the latest ones."""

_ROWS, _ROWS_BRIEF = 3, 2
"""Number of rows that the step of a running job takes, and without its step, in a sidebar as wide as Blender's own."""

_AFTER_STOP = {
    "train": " Resume continues it.",
    "mesh": " Extract Meshes continues it.",
    "film": " Render Film Frames continues it.",
    "sfm": " Import Photos or Video continues it with the same photos.",
}
"""Kind of a stopped job -> what to do next; others start anew."""


def summary(job: Job, running: Job | None = None) -> str:
    """Return the state of a job in a few words; `running`: the job that it waits for."""
    if job.state is State.WAITING and running is not None:
        return f"{job.title}: waiting for {running.title}" + " (paused)" * (running.state is State.PAUSED)
    if job.state is State.WAITING:
        return f"{job.title}: waiting"
    if job.state is State.PAUSED:
        return f"{job.title}: paused at {100 * job.progress:.0f} %"
    if job.state is State.STOPPING:
        return f"{job.title}: saving and stopping"
    left = f", {time_left(job.seconds_left)}" if job.seconds_left is not None else ""
    return f"{job.title}: {job.stage or job.message}, {100 * job.progress:.0f} %{left}"


def draw_running(
    layout: bpy.types.UILayout, job: Job, index: int, running: Job | None = None, brief: bool = False
) -> None:
    """Draw the progress and buttons of an unfinished job.

    Args:
        layout: where to draw.
        job: the job.
        index: its place in the queue.
        running: the job of the queue that runs, for which others wait.
        brief: draw its title and stage without its step and warnings.
    """
    row = layout.row(align=True)
    if job.state is State.WAITING:
        write(row.column(), summary(job, running), "TIME", inset=_BUTTON)
    else:
        left = time_left(job.seconds_left) if job.seconds_left is not None else ""
        text = {State.PAUSED: "Paused", State.STOPPING: "Saving and stopping"}.get(job.state, left)
        row.progress(factor=job.progress, text=f"{100 * job.progress:.0f} %   {text}")
    if job.can_pause:
        row.operator("objectgs.pause_job", text="", icon="PAUSE")
    if job.state is State.PAUSED:
        row.operator("objectgs.resume_job", text="", icon="PLAY")
    row.operator("objectgs.stop_job", text="", icon="X").index = index
    if job.message and job.state is not State.WAITING:
        doing = job.stage if brief else activity(job)
        write(layout, f"{job.title}: {doing}" if doing else job.title, rows=_ROWS_BRIEF if brief else _ROWS)
    if not brief:
        _draw_warnings(layout, job.warnings[-_WARNINGS:])


def activity(job: Job) -> str:
    """Return the current stage and step of a job, such as "Preparing (1 of 3): reading the splats"."""
    if not job.stage:
        return job.message
    # The message begins a sentence of its own, but not where it follows a stage.
    first, rest = job.message[:1], job.message[1:]
    return f"{job.stage}: {first.lower() if rest[:1].islower() else first}{rest}"


def draw_figures(
    layout: bpy.types.UILayout, quality: Mapping[str, float], zero_is_background: bool, splats: int | None = None
) -> None:
    """Draw the quality of a training on held-out views, and the number of its splats where it is given.

    Args:
        layout: where to draw.
        quality: those of psnr, miou and miou_all that were measured.
        zero_is_background: see `lead_miou`.
        splats: number of splats.
    """
    figures = []
    if "psnr" in quality:
        figures.append(f"PSNR {quality['psnr']:.1f} dB")
    lead = lead_miou(quality, zero_is_background)
    if lead in quality:
        figures.append(f"{MIOU_LABELS[lead]} {quality[lead]:.3f}")
    if splats:
        figures.append(f"{splats:,} splats")
    if figures:
        write(layout, "   ".join(figures))


def after_stop(job: Job) -> str:
    """Return a sentence about a stopped job."""
    return f"{job.title}: stopped.{_AFTER_STOP.get(job.kind, '')}"


def draw_over(layout: bpy.types.UILayout, job: Job) -> None:
    """Draw the outcome of a finished job and up to three warnings."""
    if job.state is State.FAILED:
        write(layout, f"{job.title} failed. {in_blender(job.error or job.message)}", "ERROR")
    elif job.state is State.STOPPED:
        write(layout, after_stop(job), "INFO")
    else:
        write(layout, f"{job.title}: done", "CHECKMARK")
    _draw_warnings(layout, job.warnings[:3])


def _draw_warnings(layout: bpy.types.UILayout, warnings: Iterable[str]) -> None:
    for sentence in warnings:
        write(layout, in_blender(sentence), "ERROR")


def write(layout: bpy.types.UILayout, text: str, icon: str = "NONE", inset: float = 0.0, rows: int = 0) -> None:
    """Draw `text`, wrapped to the width of the current region less `inset` pixels at a UI scale of 1.

    It takes at least this number of rows, so that what is below does not move when the text changes.
    """
    scale = bpy.context.preferences.system.ui_scale
    width = max(20, int((bpy.context.region.width / scale - AROUND - inset) / CHARACTER))
    column = layout.column(align=True)
    lines = textwrap.wrap(text, width)
    for line in lines + [""] * (rows - len(lines)):
        column.label(text=line, icon=icon)
        icon = icon if icon == "NONE" else "BLANK1"
