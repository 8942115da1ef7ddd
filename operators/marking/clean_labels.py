# SPDX-License-Identifier: GPL-3.0-or-later
"""Correct the masks and the splats' objects by the masks of all photos together."""

from pathlib import Path

import bpy
from bpy.props import StringProperty

from ...objectgs_addon import scene
from ...objectgs_addon.environment import locations
from ...objectgs_addon.running import background, results
from ..common import need
from ..common.jobs import LOST_EDITS, STARTS_JOB, loses_splat_edits


class CleanUpLabels(bpy.types.Operator):
    bl_idname = "objectgs.clean_up_labels"
    bl_label = "Clean Up Labels"
    bl_description = (
        "Correct parts of masks that the other photos contradict, and give the splats their objects anew. It takes up "
        "to a fifth of the time of the training. The masks before are kept in the folder masks-given of the capture"
    )
    bl_options = STARTS_JOB

    folder: StringProperty(options={"HIDDEN", "SKIP_SAVE"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.masked(cls, context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        # The message whose button names a reconstruction says what is lost.
        if self.folder or not loses_splat_edits(context):
            return self.execute(context)
        return context.window_manager.invoke_confirm(
            self,
            event,
            title="Lose Edits of Splats?",
            message=LOST_EDITS,
            confirm_text="Clean Up Labels",
            icon="WARNING",
        )

    def execute(self, context: bpy.types.Context) -> set[str]:
        root = next(iter(results.roots_of(Path(self.folder))), None) if self.folder else need.active_root(context)
        if root is None:
            self.report({"ERROR"}, f"The reconstruction in {self.folder} is not in this file any more")
            return {"CANCELLED"}
        folder = scene.folder_of(root)
        job = locations.backend_job(f"Labels of {root.name}", "label", folder, "clean-labels", str(folder))
        return background.submit(job, context.scene, self.report)


CLASSES = (CleanUpLabels,)
