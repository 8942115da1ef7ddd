# SPDX-License-Identifier: GPL-3.0-or-later
"""Open a reconstruction folder in the scene."""

from pathlib import Path

import bpy
from bpy.props import BoolProperty, StringProperty

from ...objectgs_addon import scene
from ..common.reporting import reports_errors
from ..common.show_folder import show_folder


class OpenReconstruction(bpy.types.Operator):
    bl_idname = "objectgs.open_reconstruction"
    bl_label = "Open Reconstruction"
    bl_description = "Open a reconstruction folder, made in Blender or on the command line, in this scene"
    bl_options = {"REGISTER", "UNDO"}

    directory: StringProperty(name="Reconstruction", subtype="DIR_PATH")
    filter_folder: BoolProperty(default=True, options={"HIDDEN"})

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        folder = Path(bpy.path.abspath(self.directory)).resolve()
        root = next(
            (
                collection
                for collection in context.scene.collection.children_recursive
                if scene.kind_of(collection) == "reconstruction" and scene.folder_of(collection) == folder
            ),
            None,
        )
        show_folder(self, context, folder, root)


CLASSES = (OpenReconstruction,)
