# SPDX-License-Identifier: GPL-3.0-or-later
"""Export Splats: with all edits, for other programs, in the background."""

import bpy
from bpy.props import EnumProperty, StringProperty

from ..backend.protocol import InputError
from ..objectgs_addon import locations, messages, object_edits, running, scene
from ..objectgs_addon.folder_state import folder_state
from . import need
from .export_dialog import ExportDialog


class ExportSplats(ExportDialog, bpy.types.Operator):
    bl_idname = "objectgs.export_splats"
    bl_label = "Export Splats"
    bl_description = ("Write the splats for other programs as they are seen here: without removed objects, recolored, "
                      "moved, and with duplicates")
    bl_options = {"REGISTER"}

    filter_glob: StringProperty(default="*.ply;*.spz;*.splat", options={"HIDDEN"})
    format: EnumProperty(name="Format", items=[
        ("ply", "PLY", "As 3D Gaussian splatting programs write them: exact, with the objects' IDs"),
        ("spz", "SPZ", "A fifth of the size, slightly rounded"),
        ("splat", "Splat", "For viewers in browsers: one color each, whatever the direction")])
    objects: EnumProperty(name="Objects", items=[
        ("ALL", "All", "Everything that is not removed or left out"),
        ("SELECTED", "Selected", "The objects selected in the viewport, or the active one of the list")])
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

    def execute(self, context):
        root = need.active_root(context)
        folder = scene.folder_of(root)
        chosen = self.chosen(context)
        if chosen is None:
            return {"CANCELLED"}
        out, ids = chosen
        arguments = ["export", str(folder), "--out", str(out), "--format", self.format, "--coordinates",
                     self.coordinates]
        if ids is not None:
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


CLASSES = (ExportSplats,)
