# SPDX-License-Identifier: GPL-3.0-or-later
"""Assign an object to each point by a vote of the masks."""

import bpy

from ...objectgs_addon import scene
from ...objectgs_addon.environment import locations
from ...objectgs_addon.running import background
from ...objectgs_addon.state.folder_state import folder_state
from ..common import need


class AssignObjects(bpy.types.Operator):
    bl_idname = "objectgs.assign_objects"
    bl_label = "Assign Objects"
    bl_description = "Assign an object to each point by a vote of the masks, and fill the list of objects"
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.work_on_capture(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        root = need.active_root(context)
        folder = scene.folder_of(root)
        job = locations.backend_job(
            f"Assign objects of {root.name}",
            "vote",
            folder,
            "vote",
            str(folder_state(folder).capture),
            "--out",
            str(folder),
            "--strategy",
            root.objectgs.strategy,
            "--max-size",
            str(root.objectgs.max_size),
        )
        return background.submit(job, context.scene, self.report)


CLASSES = (AssignObjects,)
