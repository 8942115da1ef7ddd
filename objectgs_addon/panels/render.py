# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders: settings for splats, film frames, and the compositor that combines the frames with Blender's renders."""

from __future__ import annotations

import bpy

from .. import scene
from ..running import background
from ..running.job_display import write
from .tab import WithReconstruction, draw_job_of


class RenderPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_render"
    bl_label = "Render"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        owner = context.scene
        root = owner.objectgs.active
        for problem in (scene.render_problem(owner, root), *scene.scene_problems(owner, root)):
            if problem is not None:
                write(layout, problem, "ERROR")
        layout.operator("objectgs.set_up_render", icon="SCENE")
        column = layout.column(align=True)
        column.operator_context = "INVOKE_REGION_WIN"
        column.operator("objectgs.camera_from_view", icon="CAMERA_DATA")
        column.operator("objectgs.camera_path", icon="CON_FOLLOWPATH")
        layout.prop(root, "hide_render", text="Disable in Renders", icon="NONE")
        if root.hide_render:
            write(layout, "Blender does not render this reconstruction; film frames show it.", "INFO")


class FilmPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_film"
    bl_label = "Film"
    bl_parent_id = "OBJECTGS_PT_render"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        owner = context.scene
        root, settings, render = owner.objectgs.active, owner.objectgs_film, owner.render
        job = background.job_of(root)
        column = layout.column()
        column.enabled = not background.is_busy(root)
        column.operator("objectgs.film_frames", icon="RENDER_ANIMATION")
        column.use_property_split = True
        column.use_property_decorate = False
        column.prop(settings, "folder", placeholder="In the reconstruction")
        frames = column.column(align=True)
        frames.prop(owner, "frame_start", text="Frame Start")
        frames.prop(owner, "frame_end", text="End")
        column.prop(render, "use_motion_blur", text="Motion Blur")
        blur = column.column(align=True)
        blur.active = render.use_motion_blur
        blur.prop(settings, "subframes")
        blur.prop(render, "motion_blur_shutter", text="Shutter")
        blur.prop(render, "motion_blur_position", text="Position")
        column.prop(settings, "png")
        if job is not None and job.kind == "film":
            draw_job_of(layout, job)
        layout.operator("objectgs.set_up_compositor", icon="NODE_COMPOSITING")
