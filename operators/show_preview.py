# SPDX-License-Identifier: GPL-3.0-or-later
"""Show the training's preview picture in an Image Editor, where it follows the training."""

import bpy

from ..objectgs_addon import previews, scene
from . import need


class ShowPreview(bpy.types.Operator):
    bl_idname = "objectgs.show_preview"
    bl_label = "Open Preview"
    bl_description = "Show in an Image Editor how training looks: photo, render and objects, kept up to date"

    @classmethod
    def poll(cls, context):
        if not need.reconstruction(cls, context):
            return False
        if previews.picture_of(scene.folder_of(need.active_root(context)), previews.COMPARISON):
            return True
        cls.poll_message_set("There is no preview yet; train first")
        return False

    def execute(self, context):
        image = previews.image_of(scene.folder_of(need.active_root(context)))
        editor = next((area for window in context.window_manager.windows for area in window.screen.areas
                       if area.type == "IMAGE_EDITOR"), None)
        if editor is None and not bpy.app.background:
            bpy.ops.wm.window_new()
            editor = context.window_manager.windows[-1].screen.areas[0]
            editor.type = "IMAGE_EDITOR"
        if editor is not None:
            editor.spaces.active.image = image
        return {"FINISHED"}


CLASSES = (ShowPreview,)
