# SPDX-License-Identifier: GPL-3.0-or-later
"""Make the demo capture, for a first try without your own photos."""

import bpy

from ...objectgs_addon.environment import locations
from ...objectgs_addon.running import background
from ..common.reporting import reports_errors


class MakeDemo(bpy.types.Operator):
    bl_idname = "objectgs.make_demo"
    bl_label = "Make Demo Capture"
    bl_description = "Render objects on a table as a capture, in the background, and import it. This takes minutes"
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        if background.busy(locations.demo_folder()):
            cls.poll_message_set("The demo capture is being made")
            return False
        return True

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        locations.reconstructions_folder()  # The import that follows must not fail by it.
        return background.submit(locations.demo_job(), context.scene, self.report)


CLASSES = (MakeDemo,)
