# SPDX-License-Identifier: GPL-3.0-or-later
"""Export the objects' meshes with Blender's own exporters."""

import bpy
from bpy.props import EnumProperty, StringProperty

from ...objectgs_addon import scene
from ...objectgs_addon.blender import messages
from ...objectgs_addon.scene.meshes import export as mesh_export
from ..common import need
from ..common.export_dialog import ExportDialog, objects_choice
from ..common.reporting import reports_errors


class ExportMeshes(ExportDialog, bpy.types.Operator):
    bl_idname = "objectgs.export_meshes"
    bl_label = "Export Meshes"
    bl_description = (
        "Export the objects' meshes with their textures and all edits: without removed objects, "
        "recolored, moved, and with duplicates"
    )
    bl_options = {"REGISTER"}

    filter_glob: StringProperty(default="*.glb;*.usdc;*.obj", options={"HIDDEN"})
    format: EnumProperty(
        name="Format",
        items=[
            ("glb", "glTF", "One file that includes its textures"),
            ("usdc", "USD", "Textures in a folder next to the file"),
            ("obj", "OBJ", "Materials and textures in files next to the file"),
        ],
    )
    objects: objects_choice("Every object that has a mesh and is not removed; if none has, the mesh of the whole scene")
    coordinates: EnumProperty(
        name="Coordinates",
        items=[
            ("blender", "Blender", "Positions in Blender, converted to the axes of the format"),
            ("capture", "Capture", "Coordinates of the captured cameras, without a change of axes"),
        ],
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not need.reconstruction(cls, context):
            return False
        root = need.active_root(context)
        if scene.object_meshes(root) or scene.scene_meshes(root):
            return True
        cls.poll_message_set("There are no meshes yet; extract them first")
        return False

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        out, ids = self.choices(context)
        root = need.active_root(context)
        files = mesh_export.export(root, out, self.format, ids, self.per_object, self.coordinates == "capture")
        text = mesh_export.summary(root, out, files, ids)
        self.report({"INFO"}, text)
        messages.show(text)


CLASSES = (ExportMeshes,)
