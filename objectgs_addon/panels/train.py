# SPDX-License-Identifier: GPL-3.0-or-later
"""Voting and training, with their settings."""

import math

import bpy

from ...backend.expectation import PRESET_STEPS, expectation
from .. import jobs, previews, running, scene
from ..folder_state import folder_state
from ..job_display import duration, write
from .tab import WithReconstruction, draw_job_of


class TrainPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_train"
    bl_label = "Vote and Train"

    def draw(self, context):
        layout = self.layout
        root = context.scene.objectgs.active
        properties = root.objectgs
        folder = scene.folder_of(root)
        job = running.job_of(root)
        if job is not None and job.kind in ("mesh", "film", "fill"):
            job = None  # Their own panels show them.
        active = running.busy(folder)
        column = layout.column()
        column.enabled = not active
        column.operator("objectgs.vote", icon="GROUP_VERTEX")
        row = column.row(align=True)
        row.operator("objectgs.train", icon="PLAY", text=_train_text(folder, properties))
        row.prop(properties, "length", text="")
        if properties.length == "minutes":
            column.prop(properties, "minutes")
        if not active:
            _expect(column, folder_state(folder), properties)
        if job is not None:
            draw_job_of(layout, job)
        if not active:
            _explain(layout, root, job)
        icons = [icon for name in (previews.RENDER, previews.CURVE) if (icon := previews.icon_of(folder, name))]
        if icons:
            row = layout.row()
            for icon in icons:
                row.template_icon(icon, scale=8.0)
            layout.operator("objectgs.show_preview", icon="IMAGE_DATA")


def _train_text(folder, properties) -> str:
    return "Go On Training" if _goes_on(folder_state(folder), properties) else "Train"


def _goes_on(state, properties) -> bool:
    return bool(state.steps) and (properties.length != "minutes" or state.seconds < 60 * properties.minutes - 0.5)


def _explain(layout, root, job) -> None:
    """What the folder holds that this Blender has not seen come about."""
    folder, minutes = scene.folder_of(root), root.objectgs.minutes
    state = folder_state(folder)
    holder = jobs.lock_holder(folder)
    if holder is not None:
        write(layout, f"Another program works on this reconstruction (process {holder}). Its result can be reloaded "
                      "when it is done.", "INFO")
        return
    if job is None and root.objectgs.length == "minutes" and _goes_on(state, root.objectgs):
        write(layout, f"Trained for {duration(state.seconds)} of {duration(60 * minutes)}. "
                      "Go On Training continues from there.", "INFO")
    if scene.result_is_newer(root):
        write(layout, "The folder holds another result than the one shown.", "INFO")
        layout.operator("objectgs.show_result", icon="FILE_REFRESH")


def _expect(layout, state, properties) -> None:
    """How good the result is going to be, where it is not there yet."""
    steps = PRESET_STEPS.get(properties.length)
    seconds = 60 * properties.minutes if properties.length == "minutes" else None
    if state.steps >= (steps or math.inf) or state.seconds >= (seconds or math.inf) - 0.5:
        return
    expected = expectation(steps, seconds, state.pixels, (state.steps, state.seconds))
    if expected is not None:
        quiet = layout.column()
        quiet.active = False
        write(quiet, expected)


class SettingsPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_settings"
    bl_label = "Settings"
    bl_parent_id = "OBJECTGS_PT_train"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
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
        layout.operator("objectgs.train", text="Train Anew", icon="LOOP_BACK").restart = True
