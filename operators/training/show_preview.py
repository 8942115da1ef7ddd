# SPDX-License-Identifier: GPL-3.0-or-later
"""Show the preview image of the training in an Image Editor."""

import bpy

from ...objectgs_addon import scene
from ...objectgs_addon.running import previews
from ..common import need


class ShowPreview(bpy.types.Operator):
    bl_idname = "objectgs.show_preview"
    bl_label = "Open Preview"
    bl_description = "Show photo, render and objects side by side in an Image Editor, updated during training"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not need.reconstruction(cls, context):
            return False
        if previews.path_of(scene.folder_of(need.active_root(context)), previews.COMPARISON):
            return True
        cls.poll_message_set("There is no preview yet; train first")
        return False

    def execute(self, context: bpy.types.Context) -> set[str]:
        image = previews.image_of(scene.folder_of(need.active_root(context)))
        editor = next(
            (
                area
                for window in context.window_manager.windows
                for area in window.screen.areas
                if area.type == "IMAGE_EDITOR"
            ),
            None,
        )
        if editor is None and not bpy.app.background:
            bpy.ops.wm.window_new()
            editor = context.window_manager.windows[-1].screen.areas[0]
            editor.type = "IMAGE_EDITOR"
        if editor is not None:
            editor.spaces.active.image = image
        return {"FINISHED"}


CLASSES = (ShowPreview,)
