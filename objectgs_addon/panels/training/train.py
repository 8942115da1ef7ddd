# SPDX-License-Identifier: GPL-3.0-or-later
"""Training, its settings and its measured quality."""

from __future__ import annotations

import math
from typing import Any

import bpy

from ....backend.shared.durations import clock
from ....backend.shared.expectation import PRESET_STEPS, expectation, expectation_in_words, typical_psnr
from ....backend.shared.reconstruction.lock import lock_holder
from ... import scene
from ...environment import locations
from ...process.jobs import Job
from ...running import background, previews
from ...running.job_display import draw_figures, write
from ...state import folder_trust
from ...state.folder_state import FolderState
from ...state.next_step import capture_problem, has_masks
from ..tab import WithReconstruction, draw_job_of
from .presets import TrainingPresets


class TrainPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_train"
    bl_label = "Train"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        root = context.scene.objectgs.active
        properties = root.objectgs
        job = _training_job(root)
        active = background.is_busy(root)
        state = folder_trust.state_of(root)
        column = layout.column()
        column.enabled = not active
        column.operator("objectgs.train", icon="PLAY", text="Resume" if _can_resume(state, properties) else "Train")
        column.prop(properties, "length")
        if properties.length == "minutes":
            column.prop(properties, "minutes")
        is_accepted = folder_trust.is_accepted(root)
        if not active and is_accepted:
            _draw_outlook(column, root, state)
        if job is not None:
            draw_job_of(layout, job)
        if not is_accepted:
            return
        if not active:
            _draw_folder_state(layout, root, job)
        elif job is not None:
            _draw_preview(layout, root)


class DetailsPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_details"
    bl_label = "Details"
    bl_parent_id = "OBJECTGS_PT_train"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        root = context.scene.objectgs.active
        if not folder_trust.is_accepted(root):
            return
        properties, state = root.objectgs, folder_trust.state_of(root)
        job = _training_job(root)
        if job is not None and job.quality:
            draw_figures(layout, job.quality, job.zero_is_background, job.splats)
        else:
            draw_figures(layout, state.quality, state.zero_is_background)
        expected = expectation(*_length_of(state, properties))
        if expected is not None:
            write(layout, f"{expected}.")
        icon = previews.icon_of(scene.folder_of(root), previews.CURVE)
        if icon:
            layout.template_icon(icon, scale=10.0)
        if not background.is_busy(root):
            _draw_preview(layout, root)


def _draw_preview(layout: bpy.types.UILayout, root: bpy.types.Collection) -> None:
    """Draw the latest render of a training, if there is one."""
    icon = previews.icon_of(scene.folder_of(root), previews.RENDER)
    if icon:
        layout.template_icon(icon, scale=12.0)
        layout.operator("objectgs.show_preview", icon="IMAGE_DATA")


def _training_job(root: bpy.types.Collection) -> Job | None:
    """Return the training that is the latest job of a reconstruction, or None."""
    job = background.job_of(root)
    return job if job is not None and job.kind == "train" else None


def _length_of(
    state: FolderState, properties: Any
) -> tuple[int | None, float | None, float | None, tuple[int, float], float | None]:
    """Return the arguments of `expectation` for the chosen length."""
    pixels = None if locations.may_use_gpu() else state.pixels
    seconds = 60 * properties.minutes if properties.length == "minutes" else None
    typical = None if state.agreement is None else typical_psnr(state.agreement, state.pixels)
    return PRESET_STEPS.get(properties.length), seconds, pixels, (state.steps, state.seconds), typical


def _draw_faint(layout: bpy.types.UILayout, text: str) -> None:
    column = layout.column()
    column.active = False
    write(column, text)


def _can_resume(state: FolderState, properties: Any) -> bool:
    if properties.length == "minutes":
        return bool(state.steps) and state.seconds < 60 * properties.minutes - 0.5
    return 0 < state.steps < PRESET_STEPS.get(properties.length, math.inf)


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


def _draw_outlook(layout: bpy.types.UILayout, root: bpy.types.Collection, state: FolderState) -> None:
    """Draw what keeps the training from its photos, or else what is expected of it."""
    needs_capture = state.imported and (state.steps or not state.trained)
    problem = capture_problem(root, state) if needs_capture else None
    if problem is not None:
        write(layout, f"{problem}.", "ERROR")
        return
    _draw_expectation(layout, state, root.objectgs)
    if not state.trained and state.imported and not has_masks(state):
        _draw_faint(layout, "There are no masks, so objects are marked after the training.")


def _draw_expectation(layout: bpy.types.UILayout, state: FolderState, properties: Any) -> None:
    """Draw the expected duration and sharpness of a training that is not finished."""
    steps, seconds, *others = _length_of(state, properties)
    if state.steps >= (steps or math.inf) or state.seconds >= (seconds or math.inf) - 0.5:
        return
    expected = expectation_in_words(steps, seconds, *others)
    if expected is not None:
        _draw_faint(layout, f"Expected on this computer: {expected}.")


class SettingsPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_settings"
    bl_label = "Settings"
    bl_parent_id = "OBJECTGS_PT_train"
    bl_options = {"DEFAULT_CLOSED"}

    def draw_header_preset(self, _context: bpy.types.Context) -> None:
        row = self.layout.row()
        row.emboss = "NONE"
        row.popover(TrainingPresets.bl_idname, text="", icon="PRESET")

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
