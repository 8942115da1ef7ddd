# SPDX-License-Identifier: GPL-3.0-or-later
"""The first panel: the latest message, the next step, the reconstruction's folder and how it is displayed."""

from __future__ import annotations

from pathlib import Path

import bpy

from .. import drawing, scene
from ..blender import messages
from ..environment import locations
from ..process.jobs import Job, State
from ..running import background
from ..running.job_display import write
from ..running.wording import IMPORT_PHOTOS
from ..state import folder_trust, visibility
from ..state.folder_state import folder_state
from ..state.next_step import IMPORT, RESUME, Step, find_step, is_capture_gone, next_step
from .preferences import draw_online_access
from .tab import Tab, draw_job

_KINDS = ("sfm", "import", "import-splats", "demo", "setup")
"""Kinds of jobs that are begun by the buttons of this panel; others say in their own panels what they do."""
_BOX = 45.0
"""Width in pixels of a box's borders and a button beside its text, at a UI scale of 1."""


class AddMenu(bpy.types.Menu):
    bl_idname = "OBJECTGS_MT_add"
    bl_label = "Add Reconstruction"

    def draw(self, context: bpy.types.Context) -> None:
        _draw_add(self.layout)
        active = context.scene.objectgs.active
        if active is not None and is_capture_gone(folder_trust.state_of(active)):
            self.layout.separator()
            _draw_button(self.layout, find_step(active))


class CapturePanel(Tab, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_capture"
    bl_label = "ObjectGS"

    def draw_header_preset(self, _context: bpy.types.Context) -> None:
        row = self.layout.row()
        row.emboss = "NONE"
        row.popover("OBJECTGS_PT_help", text="", icon="QUESTION")

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        draw_message(layout)
        active = context.scene.objectgs.active
        jobs = [
            (index, job)
            for index, job in enumerate(background.queue.jobs)
            if not job.is_finished
            and (job.kind in _KINDS or (active is not None and _is_long(job, scene.folder_of(active))))
        ]
        if active is not None or _others(context.scene):
            row = layout.row(align=True)
            row.prop(context.scene.objectgs, "active", text="")
            row.menu("OBJECTGS_MT_add", text="", icon="ADD")
        if active is not None:
            _draw_folder(layout, active)
        if step := _step(active, context.scene):
            _draw_next_step(layout, step, jobs, _must_wait(active, jobs))
        else:
            _draw_jobs(layout, jobs)
        if active is None:
            _draw_linked(layout, context.scene)
            column = layout.column(align=True)
            column.operator("objectgs.open_reconstruction", icon="FILE_FOLDER")
            column.operator("objectgs.import_splats", icon="POINTCLOUD_DATA")
            column.operator("objectgs.make_demo", icon="MESH_MONKEY")
        else:
            _draw_display(layout, context, active)


def _others(owner: bpy.types.Scene) -> bool:
    """Return whether a scene has a reconstruction that can be made the active one."""
    return any(
        scene.kind_of(each) == "reconstruction" and not scene.is_linked(each)
        for each in owner.collection.children_recursive
    )


def _must_wait(active: bpy.types.Collection | None, jobs: list[tuple[int, Job]]) -> bool:
    """Return whether the next step must wait for a job: of the same reconstruction or capture, or the set-up."""
    if active is None:
        return bool(jobs)
    folders = {scene.folder_of(active), folder_trust.state_of(active).capture}
    return background.is_busy(active) or any(job.kind == "setup" or job.folder in folders for _, job in jobs)


def draw_message(layout: bpy.types.UILayout) -> None:
    """Draw the latest message, with buttons to act on it and to dismiss it."""
    message = messages.latest()
    if message is None:
        return
    box = layout.box()
    row = box.row()
    write(row.column(), message.text, message.kind, inset=_BOX)
    row.operator("objectgs.dismiss_message", text="", icon="X", emboss=False)
    if message.operator is not None and message.label:
        button = box.operator(message.operator, text=message.label)
        for name, value in message.options.items():
            setattr(button, name, value)
    if messages.count() > 1:
        box.label(text=f"{messages.count() - 1} more")


def _draw_add(layout: bpy.types.UILayout) -> None:
    layout.operator("objectgs.import_photos", text=IMPORT_PHOTOS, icon="IMAGE_DATA")
    layout.operator("objectgs.import_capture", icon="IMPORT")
    layout.operator("objectgs.open_reconstruction", icon="FILE_FOLDER")
    layout.operator("objectgs.import_splats", icon="POINTCLOUD_DATA")
    layout.operator("objectgs.make_demo", icon="MESH_MONKEY")


def _draw_linked(layout: bpy.types.UILayout, owner: bpy.types.Scene) -> None:
    """Say where a linked reconstruction of the scene is edited."""
    for root in owner.collection.children_recursive:
        if scene.kind_of(root) == "reconstruction" and scene.is_linked(root):
            library = (root.library or root.override_library.reference.library).filepath
            write(layout, f"{root.name} is linked; edit it in {bpy.path.basename(library)}.", "LINKED")


def _step(root: bpy.types.Collection | None, owner: bpy.types.Scene) -> Step | None:
    """Return the next step, which after a stopped training is to resume it."""
    step = next_step(root, owner)
    job = background.job_of(root) if root is not None and step is not None else None
    if job is not None and job.kind == "train" and job.state is State.STOPPED and folder_trust.state_of(root).steps:
        return RESUME
    return step


def _is_long(job: Job, folder: Path) -> bool:
    """Return whether a job on a reconstruction's folder takes longer than what follows an edit, which takes seconds."""
    return job.folder == folder and job.kind != "fill"


def _draw_jobs(layout: bpy.types.UILayout, jobs: list[tuple[int, Job]]) -> None:
    for index, job in jobs:
        draw_job(layout, job, index, job.kind not in _KINDS)


def _draw_next_step(layout: bpy.types.UILayout, step: Step, jobs: list[tuple[int, Job]], must_wait: bool) -> None:
    """Draw the button of the next step with its purpose, or with the jobs that run.

    The button stays in its place while it must wait, so that what is below it does not move under the mouse.
    """
    column = layout.column()
    if step.operator == "objectgs.set_up_backend":
        draw_online_access(column)
        preferences = locations.preferences()
        if preferences is not None:
            device = column.row()
            device.enabled = not jobs
            device.prop(preferences, "device", expand=True)
    button = column.row()
    button.enabled = not must_wait
    button.scale_y = 1.5
    if step == IMPORT:
        button = button.column(align=True)
        button.operator("objectgs.import_photos", text=IMPORT_PHOTOS, icon="IMAGE_DATA")
    _draw_button(button, step)
    if jobs:
        _draw_jobs(column, jobs)
    # Most operators tell themselves why they have to wait.
    is_unexplained = must_wait and getattr(bpy.ops.objectgs, step.operator.split(".")[1]).poll()
    if is_unexplained or not jobs:
        text = column.column()
        text.active = False
        waiting = "To import something else" if step == IMPORT else f"For {step.label}"
        write(text, f"{waiting}, wait for this job or stop it." if is_unexplained else step.purpose)
    if step.operator == "objectgs.set_up_backend":
        opens = column.operator("preferences.addon_show", text="Preferences", icon="PREFERENCES")
        opens.module = locations.PACKAGE


def _draw_button(layout: bpy.types.UILayout, step: Step) -> None:
    operator = layout.operator(step.operator, text=step.label, icon=step.icon)
    for name, value in step.options:
        setattr(operator, name, value)


def _draw_display(layout: bpy.types.UILayout, context: bpy.types.Context, root: bpy.types.Collection) -> None:
    """Draw how points and splats are displayed and, where splats have replaced the points, whether cameras are."""
    failure = drawing.failure()
    if failure is not None:
        write(layout, failure, "ERROR")
    row = layout.row(align=True)
    row.prop(context.scene.objectgs, "colors", expand=True)
    row.separator()
    row.prop(context.scene.objectgs, "draw_splats", text="", icon="SHADING_RENDERED")
    layer = visibility.capture_layer(context.view_layer, root) if scene.object_collections(root) else None
    if layer is not None and any(obj.type == "CAMERA" for obj in layer.collection.objects):
        row = layout.row()
        row.alignment = "LEFT"
        # Blender draws the open or closed eye of this property by itself.
        row.prop(layer, "hide_viewport", text="Cameras", emboss=False)


def _draw_folder(layout: bpy.types.UILayout, root: bpy.types.Collection) -> None:
    """Draw the reconstruction's folder, a message if it is missing, or the question whether to use it."""
    if folder_trust.is_in_question(root):
        _draw_question(layout, folder_trust.offered(root))
        return
    folder = scene.folder_of(root)
    if not folder_state(folder).exists:
        write(
            layout,
            f"The folder {folder} is missing. The contents of this file are kept; to assign objects or train, put the "
            "folder back or import the capture again.",
            "ERROR",
        )
        return
    row = layout.row(align=True)
    row.label(text=folder.name, icon="FILE_FOLDER")
    row.operator("wm.path_open", text="", icon="FILEBROWSER").filepath = str(folder)
    row.operator("objectgs.show_result", text="", icon="FILE_REFRESH")


def _draw_question(layout: bpy.types.UILayout, folder: Path) -> None:
    """Ask whether to use the folder of a .blend that comes from elsewhere or was moved."""
    box = layout.box()
    write(box, "This file comes from elsewhere or was moved. Is this its reconstruction folder?", "QUESTION")
    write(box, str(folder))
    text = "Nothing is read, written or started there until you use it. Edits are kept in this file until then."
    column = box.column()
    column.active = False
    write(column, text)
    column = box.column(align=True)
    column.operator("objectgs.use_folder", icon="CHECKMARK").folder = str(folder)
    column.operator("objectgs.open_reconstruction", text="Choose Another...", icon="FILE_FOLDER").instead = True
