# SPDX-License-Identifier: GPL-3.0-or-later
"""Analyze the capture: decide which parts of training it needs."""

import bpy

from ...objectgs_addon import scene
from ...objectgs_addon.environment import locations
from ...objectgs_addon.running import background
from ...objectgs_addon.state import planning
from ...objectgs_addon.state.folder_state import folder_state
from ..common import need


class AnalyzeCapture(bpy.types.Operator):
    bl_idname = "objectgs.analyze_capture"
    bl_label = "Analyze Capture"
    bl_description = "Find out which parts of training this capture needs, with these settings and chosen objects"
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.work_on_capture(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        root = need.active_root(context)
        folder = scene.folder_of(root)
        job = locations.backend_job(
            f"Analyze {root.name}",
            "plan",
            folder,
            "plan",
            str(folder_state(folder).capture),
            "--out",
            str(folder),
            *planning.arguments(root),
        )
        return background.submit(job, context.scene, self.report)


CLASSES = (AnalyzeCapture,)
