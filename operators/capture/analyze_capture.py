# SPDX-License-Identifier: GPL-3.0-or-later
"""Analyze the capture: decide which parts of training it needs."""

import bpy

from ...objectgs_addon.state import planning
from ..common import need
from ..common.jobs import STARTS_JOB, submit_for_capture


class AnalyzeCapture(bpy.types.Operator):
    bl_idname = "objectgs.analyze_capture"
    bl_label = "Analyze Capture"
    bl_description = "Find out which parts of training this capture needs, with these settings and chosen objects"
    bl_options = STARTS_JOB

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.work_on_capture(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        arguments = planning.arguments(need.active_root(context))
        return submit_for_capture(self, context, "Analyze", "plan", *arguments)


CLASSES = (AnalyzeCapture,)
