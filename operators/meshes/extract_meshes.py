# SPDX-License-Identifier: GPL-3.0-or-later
"""Extract a textured mesh of each object, in the background."""

import bpy

from ...objectgs_addon import scene
from ...objectgs_addon.environment import locations
from ...objectgs_addon.running import background
from ...objectgs_addon.state import object_list
from ..common import need
from ..common.jobs import STARTS_JOB
from ..common.reporting import reports_errors


class ExtractMeshes(bpy.types.Operator):
    bl_idname = "objectgs.extract_meshes"
    bl_label = "Extract Meshes"
    bl_description = (
        "Extract a textured mesh of each object in place, in the background. Existing meshes are updated and "
        "keep their materials; those that would not change are skipped"
    )
    bl_options = STARTS_JOB

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.work_on_capture(cls, context) and need.training(cls, context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = need.active_root(context)
        properties = root.objectgs
        folder = scene.folder_of(root)
        arguments = ["mesh", str(folder), "--faces", str(properties.mesh_faces)]
        if properties.mesh_objects == "selected":
            arguments += ["--objects", *map(str, object_list.require_chosen_ids(context, root))]
        elif properties.mesh_scene:
            # --scene without --objects would make the mesh of the whole scene alone.
            ids = [
                scene.from_stored(item.object_id) for item in properties.objects if item.chosen and not item.is_merged
            ]
            arguments += ["--objects", *map(str, ids)] if ids else []
        if properties.mesh_scene:
            arguments.append("--scene")
        if not properties.mesh_closed:
            arguments.append("--open")
        if properties.texture_size != "auto":
            arguments += ["--texture-size", properties.texture_size]
        job = locations.backend_job(f"Meshes of {root.name}", "mesh", folder, *arguments)
        return background.submit(job, context.scene, self.report)


CLASSES = (ExtractMeshes,)
