# SPDX-License-Identifier: GPL-3.0-or-later
"""Dismiss the message that the ObjectGS tab shows."""

import bpy

from ...objectgs_addon.blender import messages
from ...objectgs_addon.running import background


class DismissMessage(bpy.types.Operator):
    bl_idname = "objectgs.dismiss_message"
    bl_label = "Dismiss"
    bl_description = "Remove this message"
    bl_options = {"INTERNAL"}

    def execute(self, _context: bpy.types.Context) -> set[str]:
        messages.dismiss()
        background.redraw()
        return {"FINISHED"}


CLASSES = (DismissMessage,)
