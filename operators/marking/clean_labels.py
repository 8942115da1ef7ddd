# SPDX-License-Identifier: GPL-3.0-or-later
"""Correct the masks and the splats' objects by the masks of all photos together."""

import bpy

from ...objectgs_addon import scene
from ...objectgs_addon.environment import locations
from ...objectgs_addon.running import background
from ..common import need
from ..common.jobs import STARTS_JOB


class CleanUpLabels(bpy.types.Operator):
    bl_idname = "objectgs.clean_up_labels"
    bl_label = "Clean Up Labels"
    bl_description = (
        "Correct parts of masks that the other photos contradict, and give the splats their objects anew. It takes up "
        "to a fifth of the time of the training. The masks before are kept in the folder masks-given of the capture"
    )
    bl_options = STARTS_JOB

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.masked(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        root = need.active_root(context)
        folder = scene.folder_of(root)
        job = locations.backend_job(f"Labels of {root.name}", "label", folder, "clean-labels", str(folder))
        return background.submit(job, context.scene, self.report)


CLASSES = (CleanUpLabels,)
