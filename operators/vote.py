# SPDX-License-Identifier: GPL-3.0-or-later
"""Vote: give each point the object that the masks show there."""

import bpy

from ..objectgs_addon import locations, running, scene
from ..objectgs_addon.folder_state import folder_state
from . import need


class Vote(bpy.types.Operator):
    bl_idname = "objectgs.vote"
    bl_label = "Vote"
    bl_description = "Find each point's object from the masks; fills the list of objects"
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context):
        return need.work_on_capture(cls, context)

    def execute(self, context):
        root = need.active_root(context)
        folder = scene.folder_of(root)
        job = locations.backend_job(
            f"Vote on {root.name}", "vote", folder, "vote", str(folder_state(folder).capture), "--out", str(folder),
            "--strategy", root.objectgs.strategy, "--max-size", str(root.objectgs.max_size))
        return running.submit(job, context.scene, self.report)


CLASSES = (Vote,)
