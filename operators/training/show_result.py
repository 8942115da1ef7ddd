# SPDX-License-Identifier: GPL-3.0-or-later
"""Reload the active reconstruction from its folder."""

import bpy

from ...objectgs_addon import scene
from ...objectgs_addon.blender import messages
from ...objectgs_addon.state import object_list
from ..common import need
from ..common.reporting import reports_errors
from ..common.show_folder import show_folder


class ShowResult(bpy.types.Operator):
    bl_idname = "objectgs.show_result"
    bl_label = "Reload Result"
    bl_description = (
        "Reload points, splats and meshes from the reconstruction folder, keeping transforms, names and materials"
    )
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.reconstruction(cls, context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root = need.active_root(context)
        show_folder(self, context, scene.folder_of(root), root)
        messages.withdraw(object_list.newer_edits(root))


CLASSES = (ShowResult,)
