# SPDX-License-Identifier: GPL-3.0-or-later
"""Export Splats: with all edits, for other programs, in the background."""

from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, StringProperty

from ..backend.protocol import InputError
from ..objectgs_addon import locations, messages, object_edits, running, scene
from ..objectgs_addon.folder_state import folder_state
from . import need

FORMATS = ("ply", "spz", "splat")


class ExportSplats(bpy.types.Operator):
    bl_idname = "objectgs.export_splats"
    bl_label = "Export Splats"
    bl_description = ("Write the splats for other programs as they are seen here: without removed objects, recolored, "
                      "moved, and with duplicates")
    bl_options = {"REGISTER"}

    filepath: StringProperty(name="File", subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: StringProperty(default="*.ply;*.spz;*.splat", options={"HIDDEN"})
    check_existing: BoolProperty(default=True, options={"HIDDEN"})
    format: EnumProperty(name="Format", items=[
        ("ply", "PLY", "As 3D Gaussian splatting programs write them: exact, with the objects' IDs"),
        ("spz", "SPZ", "A fifth of the size, slightly rounded"),
        ("splat", "Splat", "For viewers in browsers: one color each, whatever the direction")])
    objects: EnumProperty(name="Objects", items=[
        ("ALL", "All", "Everything that is not removed or left out"),
        ("SELECTED", "Selected", "The objects selected in the viewport, or the active one of the list")])
    per_object: BoolProperty(name="A File Each", description="A folder with a file for each object")
    coordinates: EnumProperty(name="Coordinates", items=[
        ("capture", "Capture", "Those of COLMAP, which photos and cameras have"),
        ("blender", "Upright", "Z up, as the capture was when it was imported")])

    @classmethod
    def poll(cls, context):
        if not need.backend(cls) or not need.reconstruction(cls, context) or not need.idle(cls, context):
            return False
        if folder_state(scene.folder_of(need.active_root(context))).trained:
            return True
        cls.poll_message_set("There are no splats yet; train first")
        return False

    def invoke(self, context, _event):
        if not self.filepath:
            self.filepath = f"{bpy.path.clean_name(need.active_root(context).name)}.{self.format}"
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def check(self, _context):
        wanted = str(_with_suffix(Path(self.filepath), self.format, self.per_object))
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
        folder = scene.folder_of(root)
        if not self.filepath:
            self.report({"ERROR"}, "Choose a file to write")
            return {"CANCELLED"}
        out = _with_suffix(Path(bpy.path.abspath(self.filepath)).resolve(), self.format, self.per_object)
        arguments = ["export", str(folder), "--out", str(out), "--format", self.format, "--coordinates",
                     self.coordinates]
        if self.objects == "SELECTED":
            ids = object_edits.chosen_ids(context, root)
            if not ids:
                self.report({"ERROR"}, "No object is selected; select one in the viewport or in the list")
                return {"CANCELLED"}
            arguments += ["--objects", *map(str, ids)]
        if self.per_object:
            arguments.append("--per-object")
        try:
            object_edits.store_edits(root)
        except (InputError, OSError) as error:
            self.report({"ERROR"}, messages.sentence(error))
            return {"CANCELLED"}
        job = locations.backend_job(f"Export {out.name}", "export", folder, *arguments)
        return running.submit(job, context.scene, self.report)


def _with_suffix(path: Path, wanted: str, is_folder: bool) -> Path:
    """The path with the format's suffix, or, of a folder, without any."""
    bare = path.with_suffix("") if path.suffix[1:].lower() in FORMATS else path
    return bare if is_folder else bare.with_name(f"{bare.name}.{wanted}")


CLASSES = (ExportSplats,)
