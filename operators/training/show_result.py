# SPDX-License-Identifier: GPL-3.0-or-later
"""Show the contents of a reconstruction folder in the scene."""

from pathlib import Path
from typing import Any

import bpy
from bpy.props import BoolProperty, StringProperty

from ...backend.shared.errors import InputError
from ...backend.shared.reconstruction.folder import Reconstruction
from ...objectgs_addon import scene
from ...objectgs_addon.blender import messages
from ...objectgs_addon.running import running
from ...objectgs_addon.state import object_edits
from ...objectgs_addon.state import viewports as view
from ..common import need
from ..common.reporting import reports_errors


class ShowResult(bpy.types.Operator):
    bl_idname = "objectgs.show_result"
    bl_label = "Reload Result"
    bl_description = (
        "Reload points, splats and meshes from the reconstruction folder, keeping transforms, names and materials"
    )
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.reconstruction(cls, context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root = need.active_root(context)
        _show(self, context, scene.folder_of(root), root)


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
        _show(self, context, folder, root)


def _show(operator: bpy.types.Operator, context: bpy.types.Context, folder: Path, root: Any) -> None:
    root = scene.show_capture(context.scene, folder, root)
    object_edits.fill(root)
    context.scene.objectgs.active = root
    try:
        if Reconstruction(folder).splats.exists():
            if not scene.object_collections(root):
                view.hide_points(root)
            shown = scene.show_result(root, folder)
            for sentence in shown.warnings:
                operator.report({"WARNING"}, sentence)
            operator.report({"INFO"}, f"{shown.splats:,} splats of {shown.objects} objects")
            object_edits.fill(root)
            running.fill_holes(root)
    except (InputError, OSError) as error:
        operator.report({"ERROR"}, messages.sentence(error))  # Cameras and points are shown; they need an undo step.


CLASSES = (ShowResult, OpenReconstruction)
