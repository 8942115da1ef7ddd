# SPDX-License-Identifier: GPL-3.0-or-later
"""Export Meshes: the objects' meshes by Blender's own exporters, in one click."""

import bpy
from bpy.props import EnumProperty, StringProperty

from ..backend.protocol import InputError
from ..objectgs_addon import mesh_export, messages, scene
from . import need
from .export_dialog import ExportDialog


class ExportMeshes(ExportDialog, bpy.types.Operator):
    bl_idname = "objectgs.export_meshes"
    bl_label = "Export Meshes"
    bl_description = ("Write the objects' meshes with their textures for other programs as they are seen here: without "
                      "removed objects, recolored, moved, and with duplicates")
    bl_options = {"REGISTER"}

    filter_glob: StringProperty(default="*.glb;*.usdc;*.obj", options={"HIDDEN"})
    format: EnumProperty(name="Format", items=[
        ("glb", "glTF", "One file with its textures"), ("usdc", "USD", "Textures in a folder beside it"),
        ("obj", "OBJ", "Materials and textures in files beside it")])
    objects: EnumProperty(name="Objects", items=[
        ("ALL", "All", "Every object with a mesh that is not removed"),
        ("SELECTED", "Selected", "The objects selected in the viewport, or the active one of the list")])
    coordinates: EnumProperty(name="Coordinates", items=[
        ("blender", "Blender", "As they stand in Blender, in the format's own axes"),
        ("capture", "Capture", "Those of COLMAP, which photos and cameras have, without a change of axes")])

    @classmethod
    def poll(cls, context):
        if not need.reconstruction(cls, context):
            return False
        if scene.object_meshes(need.active_root(context)):
            return True
        cls.poll_message_set("There are no meshes yet; extract them first")
        return False

    def execute(self, context):
        root = need.active_root(context)
        chosen = self.chosen(context)
        if chosen is None:
            return {"CANCELLED"}
        out, ids = chosen
        try:
            files = mesh_export.export(root, out, self.format, ids, self.per_object, self.coordinates == "capture")
        except (InputError, OSError, RuntimeError) as error:
            self.report({"ERROR"}, messages.sentence(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Wrote {files[0] if len(files) == 1 else f'{len(files)} files into {out}'}")
        return {"FINISHED"}


CLASSES = (ExportMeshes,)
