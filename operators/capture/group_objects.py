# SPDX-License-Identifier: GPL-3.0-or-later
"""Merge the IDs that a labels file gives the same name."""

from pathlib import Path

import bpy
from bpy.props import StringProperty

from ...objectgs_addon.state import object_edits
from ..common import need
from ..common.reporting import reports_errors


class GroupObjects(bpy.types.Operator):
    bl_idname = "objectgs.group_objects"
    bl_label = "Group by File"
    bl_description = 'Merge all IDs with the same name in a labels file, such as "chair", into one object'
    bl_options = {"REGISTER", "UNDO"}

    filepath: StringProperty(name="Labels", subtype="FILE_PATH", description="JSON file with IDs and names")
    filter_glob: StringProperty(default="*.json", options={"HIDDEN"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.objects(cls, context) and need.idle(cls, context)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        object_edits.group(need.active_root(context), Path(bpy.path.abspath(self.filepath)))


CLASSES = (GroupObjects,)
