# SPDX-License-Identifier: GPL-3.0-or-later
"""Extract Meshes: a closed, textured mesh of each object, in the background."""

import bpy

from ..objectgs_addon import locations, object_edits, running, scene
from . import need


class ExtractMeshes(bpy.types.Operator):
    bl_idname = "objectgs.extract_meshes"
    bl_label = "Extract Meshes"
    bl_description = ("Make a textured mesh of each object in the background, exactly where it is. Meshes that are "
                      "there are updated and keep their materials; those that would come out the same stay")
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context):
        return (need.backend(cls) and need.reconstruction(cls, context) and need.idle(cls, context)
                and need.capture(cls, context) and need.training(cls, context))

    def execute(self, context):
        root = need.active_root(context)
        properties = root.objectgs
        folder = scene.folder_of(root)
        arguments = ["mesh", str(folder), "--faces", str(properties.mesh_faces)]
        if properties.mesh_objects == "selected":
            ids = object_edits.chosen_ids(context, root)
            if not ids:
                self.report({"ERROR"}, "No object is selected; select one in the viewport or in the list")
                return {"CANCELLED"}
            arguments += ["--objects", *map(str, ids)]
        elif properties.mesh_scene:
            # The whole scene alone is what --scene would mean without.
            ids = [object_edits.from_stored(item.object_id) for item in properties.objects
                   if item.chosen and not item.is_merged]
            arguments += ["--objects", *map(str, ids)] if ids else []
        if properties.mesh_scene:
            arguments.append("--scene")
        if not properties.mesh_closed:
            arguments.append("--open")
        if properties.texture_size != "auto":
            arguments += ["--texture-size", properties.texture_size]
        job = locations.backend_job(f"Meshes of {root.name}", "mesh", folder, *arguments)
        return running.submit(job, context.scene, self.report)


CLASSES = (ExtractMeshes,)
