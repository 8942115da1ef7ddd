# SPDX-License-Identifier: GPL-3.0-or-later
"""Assignment of objects and training, with their settings."""

from __future__ import annotations

import math
from typing import Any

import bpy

from ...backend.shared.durations import clock
from ...backend.shared.expectation import PRESET_STEPS, expectation
from ...backend.shared.reconstruction.lock import lock_holder
from .. import scene
from ..process.jobs import Job
from ..running import background, previews
from ..running.job_display import write
from ..state import folder_trust
from ..state.folder_state import FolderState
from .tab import WithReconstruction, draw_job_of


class TrainPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_train"
    bl_label = "Train"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        root = context.scene.objectgs.active
        properties = root.objectgs
        folder = scene.folder_of(root)
        job = background.job_of(root)
        if job is not None and job.kind in ("mesh", "film", "fill"):
            job = None  # Other panels show these.
        active = background.busy(folder)
        column = layout.column()
        column.enabled = not active
        column.operator("objectgs.assign_objects", icon="GROUP_VERTEX")
        row = column.row(align=True)
        state = folder_trust.state_of(root)
        row.operator("objectgs.train", icon="PLAY", text="Resume" if _can_resume(state, properties) else "Train")
        row.prop(properties, "length", text="")
        if properties.length == "minutes":
            column.prop(properties, "minutes")
        is_accepted = folder_trust.is_accepted(root)
        if not active and is_accepted:
            _draw_expectation(column, state, properties)
        if job is not None:
            draw_job_of(layout, job)
        if not is_accepted:
            return
        if not active:
            _draw_folder_state(layout, root, job)
        icons = [icon for name in (previews.RENDER, previews.CURVE) if (icon := previews.icon_of(folder, name))]
        if icons:
            row = layout.row()
            for icon in icons:
                row.template_icon(icon, scale=8.0)
            layout.operator("objectgs.show_preview", icon="IMAGE_DATA")


def _can_resume(state: FolderState, properties: Any) -> bool:
    return bool(state.steps) and (properties.length != "minutes" or state.seconds < 60 * properties.minutes - 0.5)


def _draw_folder_state(layout: bpy.types.UILayout, root: bpy.types.Collection, job: Job | None) -> None:
    """Draw the state of the folder that no job of this session has produced."""
    folder, minutes = scene.folder_of(root), root.objectgs.minutes
    state = folder_trust.state_of(root)
    holder = lock_holder(folder)
    if holder is not None:
        process = f" (process {holder})" if holder else ""
        write(
            layout,
            f"Another program{process} is using this reconstruction. Reload the result when it is done.",
            "INFO",
        )
        return
    if job is None and root.objectgs.length == "minutes" and _can_resume(state, root.objectgs):
        write(
            layout,
            f"Trained for {clock(state.seconds)} of {clock(60 * minutes)}. Resume continues from there.",
            "INFO",
        )
    if scene.result_is_newer(root):
        write(layout, "The result in the folder differs from the one shown.", "INFO")
        layout.operator("objectgs.show_result", icon="FILE_REFRESH")


def _draw_expectation(layout: bpy.types.UILayout, state: FolderState, properties: Any) -> None:
    """Draw the expected quality of a training that is not finished."""
    steps = PRESET_STEPS.get(properties.length)
    seconds = 60 * properties.minutes if properties.length == "minutes" else None
    if state.steps >= (steps or math.inf) or state.seconds >= (seconds or math.inf) - 0.5:
        return
    expected = expectation(steps, seconds, state.pixels, (state.steps, state.seconds))
    if expected is not None:
        column = layout.column()
        column.active = False
        write(column, expected)


class SettingsPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_settings"
    bl_label = "Settings"
    bl_parent_id = "OBJECTGS_PT_train"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        properties = context.scene.objectgs.active.objectgs
        layout.prop(properties, "mode")
        row = layout.row()
        row.active = properties.mode == "explicit"
        row.prop(properties, "sh_degree")
        layout.prop(properties, "primitive")
        layout.prop(properties, "strategy")
        layout.prop(properties, "max_size")
        layout.operator("objectgs.train", text="Retrain", icon="LOOP_BACK").restart = True
