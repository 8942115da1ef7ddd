# SPDX-License-Identifier: GPL-3.0-or-later
"""Export Meshes: the objects' meshes by Blender's own exporters, in one click."""

from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, StringProperty

from ..backend.protocol import InputError
from ..objectgs_addon import mesh_export, messages, object_edits, scene
from . import need


class ExportMeshes(bpy.types.Operator):
    bl_idname = "objectgs.export_meshes"
    bl_label = "Export Meshes"
    bl_description = ("Write the objects' meshes with their textures for other programs as they are seen here: without "
                      "removed objects, recolored, moved, and with duplicates")
    bl_options = {"REGISTER"}

    filepath: StringProperty(name="File", subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: StringProperty(default="*.glb;*.usdc;*.obj", options={"HIDDEN"})
    check_existing: BoolProperty(default=True, options={"HIDDEN"})
    format: EnumProperty(name="Format", items=[
        ("glb", "glTF", "One file with its textures"), ("usdc", "USD", "Textures in a folder beside it"),
        ("obj", "OBJ", "Materials and textures in files beside it")])
    objects: EnumProperty(name="Objects", items=[
        ("ALL", "All", "Every object with a mesh that is not removed"),
        ("SELECTED", "Selected", "The objects selected in the viewport, or the active one of the list")])
    per_object: BoolProperty(name="A File Each", description="A folder with a file for each object")
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

    def invoke(self, context, _event):
        if not self.filepath:
            self.filepath = f"{bpy.path.clean_name(need.active_root(context).name)}.{self.format}"
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def check(self, _context):
        wanted = str(mesh_export.with_suffix(Path(self.filepath), self.format, self.per_object))
        changed, self.filepath = wanted != self.filepath, wanted
        return changed

    def draw(self, _context):
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "format")
        layout.prop(self, "objects", expand=True)
        layout.prop(self, "per_object")
        layout.prop(self, "coordinates")

    def execute(self, context):
        root = need.active_root(context)
        if not self.filepath:
            self.report({"ERROR"}, "Choose a file to write")
            return {"CANCELLED"}
        ids = None
        if self.objects == "SELECTED":
            ids = object_edits.chosen_ids(context, root)
        out = mesh_export.with_suffix(Path(bpy.path.abspath(self.filepath)).resolve(), self.format, self.per_object)
        try:
            files = mesh_export.export(root, out, self.format, ids, self.per_object, self.coordinates == "capture")
        except (InputError, OSError, RuntimeError) as error:
            self.report({"ERROR"}, messages.sentence(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Wrote {files[0] if len(files) == 1 else f'{len(files)} files into {out}'}")
        return {"FINISHED"}


CLASSES = (ExportMeshes,)
