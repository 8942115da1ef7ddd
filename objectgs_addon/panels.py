# SPDX-License-Identifier: GPL-3.0-or-later
"""The ObjectGS tab in the 3D viewport's sidebar, and the line in the status bar."""

import bpy

from . import jobs, locations, previews, running, scene
from .folder_state import folder_state
from .job_display import draw_over, draw_running, duration, summary, write
from .object_list import describe


class _Tab:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "ObjectGS"


class _WithReconstruction(_Tab):
    @classmethod
    def poll(cls, context):
        return context.scene.objectgs.active is not None


class CapturePanel(_Tab, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_capture"
    bl_label = "ObjectGS"

    def draw(self, context):
        layout = self.layout
        if locations.backend_python() is None:
            box = layout.box()
            write(box, "The compute backend is not set up yet.", "INFO")
            opens = box.operator("preferences.addon_show", text="Open Preferences", icon="PREFERENCES")
            opens.module = locations.PACKAGE
        column = layout.column(align=True)
        column.operator("objectgs.import_capture", icon="IMPORT")
        column.operator("objectgs.open_reconstruction", icon="FILE_FOLDER")
        column.operator("objectgs.make_demo", icon="MESH_MONKEY")
        for index, job in enumerate(running.queue.jobs):
            if job.kind in ("import", "demo") and (not job.is_finished or job.state is jobs.State.FAILED):
                _draw_job(layout, job, index)
        active = context.scene.objectgs.active
        if active is not None:
            layout.prop(context.scene.objectgs, "active", text="")
            _draw_folder(layout, active)


def _draw_folder(layout, root) -> None:
    """Where the reconstruction is, and what is wrong with it."""
    folder = scene.folder_of(root)
    state = folder_state(folder)
    if not state.exists:
        write(layout, f"The folder {folder} is gone. What is in this file stays as it is; to train or vote, put the "
                      "folder back or import the capture again.", "ERROR")
        return
    row = layout.row(align=True)
    row.label(text=folder.name, icon="FILE_FOLDER")
    row.operator("wm.path_open", text="", icon="FILEBROWSER").filepath = str(folder)
    row.operator("objectgs.show_result", text="", icon="FILE_REFRESH")


class TrainPanel(_WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_train"
    bl_label = "Vote and Train"

    def draw(self, context):
        layout = self.layout
        root = context.scene.objectgs.active
        properties = root.objectgs
        folder = scene.folder_of(root)
        job = running.job_of(root)
        if job is not None and job.kind == "mesh":
            job = None  # The panel Meshes shows it.
        active = running.busy(folder)
        column = layout.column()
        column.enabled = not active
        column.operator("objectgs.vote", icon="GROUP_VERTEX")
        row = column.row(align=True)
        row.operator("objectgs.train", icon="PLAY", text=_train_text(folder, properties.minutes))
        row.prop(properties, "minutes", text="Minutes")
        if job is not None:
            _draw_job_of(layout, job)
        if not active:
            _explain(layout, root, job)
        icon = previews.icon_of(folder)
        if icon:
            layout.template_icon(icon, scale=8.0)
            layout.operator("objectgs.show_preview", icon="IMAGE_DATA")


def _draw_job_of(layout, job) -> None:
    """A reconstruction's job in the panel of what it does."""
    if job.is_finished:
        draw_over(layout, job)
    else:
        _draw_job(layout, job, running.queue.jobs.index(job))


def _train_text(folder, minutes: float) -> str:
    state = folder_state(folder)
    return "Go On Training" if state.steps and state.seconds < 60 * minutes else "Train"


def _explain(layout, root, job) -> None:
    """What the folder holds that this Blender has not seen come about."""
    folder, minutes = scene.folder_of(root), root.objectgs.minutes
    state = folder_state(folder)
    holder = jobs.lock_holder(folder)
    if holder is not None:
        write(layout, f"Another program works on this reconstruction (process {holder}). Its result can be reloaded "
                      "when it is done.", "INFO")
        return
    if job is None and state.steps and state.seconds < 60 * minutes - 0.5:
        write(layout, f"Trained for {duration(state.seconds)} of {duration(60 * minutes)}. "
                      "Go On Training continues from there.", "INFO")
    if scene.result_is_newer(root):
        write(layout, "The folder holds another result than the one shown.", "INFO")
        layout.operator("objectgs.show_result", icon="FILE_REFRESH")


class SettingsPanel(_WithReconstruction, bpy.types.Panel):
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


class ObjectsPanel(_WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_objects"
    bl_label = "Objects"

    def draw(self, context):
        layout = self.layout
        properties = context.scene.objectgs.active.objectgs
        if not properties.objects:
            write(layout, "Vote to find the objects.", "INFO")
            return
        row = layout.row()
        row.template_list("OBJECTGS_UL_objects", "", properties, "objects", properties, "active_object", rows=8)
        column = row.column(align=True)
        column.operator("objectgs.select_object", text="", icon="RESTRICT_SELECT_OFF")
        column.operator("objectgs.solo_object", text="", icon="SOLO_ON")
        column.separator()
        column.operator("objectgs.merge_objects", text="", icon="AUTOMERGE_ON")
        column.operator("objectgs.split_objects", text="", icon="UNLINKED")
        column.separator()
        column.operator_menu_enum("objectgs.choose_objects", "which", text="", icon="CHECKBOX_HLT")
        if 0 <= properties.active_object < len(properties.objects):
            write(layout, describe(properties.objects[properties.active_object], properties))
        left_out = sum(not item.chosen for item in properties.objects)
        if left_out:
            layout.label(text=f"{left_out} of {len(properties.objects)} are left out when training")
        layout.prop(context.scene.objectgs, "select_whole")


class MeshesPanel(_WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_meshes"
    bl_label = "Meshes"

    def draw(self, context):
        layout = self.layout
        root = context.scene.objectgs.active
        properties = root.objectgs
        folder = scene.folder_of(root)
        state = folder_state(folder)
        job = running.job_of(root)
        column = layout.column()
        column.enabled = not running.busy(folder)
        column.operator("objectgs.extract_meshes", icon="MESH_DATA")
        column.row().prop(properties, "mesh_objects", expand=True)
        column.use_property_split = True
        column.prop(properties, "mesh_faces")
        column.prop(properties, "texture_size")
        column.prop(properties, "mesh_closed")
        column.prop(properties, "mesh_scene")
        if job is not None and job.kind == "mesh":
            _draw_job_of(layout, job)
        if state.stale_meshes and not running.busy(folder):
            write(layout, f"{state.stale_meshes} of {state.meshes} meshes are of another state of the training. "
                          "Extract Meshes brings them up to date.", "INFO")
        if not scene.has_shown_meshes(root):
            return
        layout.label(text="Show")
        layout.row().prop(properties, "shown", expand=True)
        for mesh in scene.scene_meshes(root):
            row = layout.row(align=True)
            row.label(text=mesh.name, icon="OUTLINER_OB_MESH")
            row.prop(mesh, "hide_viewport", text="", emboss=False)
            row.prop(mesh, "hide_render", text="", emboss=False)
        layout.operator("objectgs.mark_assets", icon="ASSET_MANAGER")


class DisplayPanel(_WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_display"
    bl_label = "Placement and Display"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        layout = self.layout
        properties = context.scene.objectgs.active.objectgs
        column = layout.column(align=True)
        column.operator("objectgs.set_ground", icon="ORIENTATION_NORMAL")
        column.operator("objectgs.set_distance", icon="DRIVER_DISTANCE")
        layout.label(text="Color points by")
        layout.row().prop(properties, "colour_by", expand=True)
        layout.label(text="Splats: objects or photo")
        row = layout.row(align=True)
        row.prop_enum(context.space_data.shading, "type", "SOLID", text="Objects")
        row.prop_enum(context.space_data.shading, "type", "MATERIAL", text="Photo")


class JobsPanel(_Tab, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_jobs"
    bl_label = "Jobs"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, _context):
        return bool(running.queue.jobs)

    def draw(self, _context):
        layout = self.layout
        for index, job in enumerate(running.queue.jobs):
            _draw_job(layout, job, index)
        layout.operator("objectgs.clear_jobs", icon="X")


def _draw_job(layout, job, index: int) -> None:
    box = layout.box()
    if job.is_finished:
        draw_over(box, job)
    else:
        draw_running(box, job, index)


def _status_bar(bar, _context) -> None:
    job = running.queue.running
    if job is not None:
        row = bar.layout.row(align=True)
        row.label(text=f"ObjectGS  {summary(job)}", icon="TIME")
        row.operator("objectgs.stop_job", text="", icon="X", emboss=False)


CLASSES = (CapturePanel, TrainPanel, SettingsPanel, ObjectsPanel, MeshesPanel, DisplayPanel, JobsPanel)


def register():
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.STATUSBAR_HT_header.append(_status_bar)


def unregister():
    bpy.types.STATUSBAR_HT_header.remove(_status_bar)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
