# SPDX-License-Identifier: GPL-3.0-or-later
"""Assign an object to each point by a vote of the masks."""

import bpy

from ..common import need
from ..common.jobs import STARTS_JOB, submit_for_capture


class AssignObjects(bpy.types.Operator):
    bl_idname = "objectgs.assign_objects"
    bl_label = "Assign Objects"
    bl_description = "Assign an object to each point by a vote of the masks, and fill the list of objects"
    bl_options = STARTS_JOB

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.work_on_capture(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        properties = need.active_root(context).objectgs
        arguments = ("--strategy", properties.strategy, "--max-size", str(properties.max_size))
        return submit_for_capture(self, context, "Assign objects of", "vote", *arguments)


CLASSES = (AssignObjects,)
