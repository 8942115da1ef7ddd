# SPDX-License-Identifier: GPL-3.0-or-later
"""Show what a reconstruction folder holds: its objects' collections, or all of it from a folder."""

from pathlib import Path

import bpy
from bpy.props import StringProperty

from ..backend.protocol import InputError, Reconstruction
from ..objectgs_addon import messages, object_edits, running, scene, view
from . import need


class ShowResult(bpy.types.Operator):
    bl_idname = "objectgs.show_result"
    bl_label = "Reload Result"
    bl_description = ("Bring points, splats and meshes up to date with the reconstruction folder; transforms, names "
                      "and materials stay")
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        return need.reconstruction(cls, context)

    def execute(self, context):
        root = need.active_root(context)
        return _show(self, context, scene.folder_of(root), root)


class OpenReconstruction(bpy.types.Operator):
    bl_idname = "objectgs.open_reconstruction"
    bl_label = "Open Reconstruction"
    bl_description = "Bring a reconstruction folder, made here or by the command line, into this scene"
    bl_options = {"REGISTER", "UNDO"}

    directory: StringProperty(name="Reconstruction", subtype="DIR_PATH")
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})

    def invoke(self, context, _event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        folder = Path(bpy.path.abspath(self.directory)).resolve()
        root = next((collection for collection in context.scene.collection.children_recursive
                     if scene.kind_of(collection) == "reconstruction" and scene.folder_of(collection) == folder), None)
        return _show(self, context, folder, root)


def _show(operator, context, folder: Path, root) -> set:
    try:
        root = scene.show_capture(context.scene, folder, root)
        object_edits.fill(root)
    except (InputError, OSError) as error:
        operator.report({"ERROR"}, messages.sentence(error))
        return {"CANCELLED"}
    context.scene.objectgs.active = root
    try:
        if Reconstruction(folder).splats.exists():
            if not scene.object_collections(root):
                view.hide_points(root)
            shown = scene.show_result(root, folder, context.scene)
            for sentence in shown.warnings:
                operator.report({"WARNING"}, sentence)
            operator.report({"INFO"}, f"{shown.splats:,} splats of {shown.objects} objects")
            object_edits.fill(root)
            running.close_places(root)
    except (InputError, OSError) as error:
        operator.report({"ERROR"}, messages.sentence(error))  # Cameras and points are there, and can be undone.
    return {"FINISHED"}


CLASSES = (ShowResult, OpenReconstruction)
