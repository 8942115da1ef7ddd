# SPDX-License-Identifier: GPL-3.0-or-later
"""Make the built-in demo capture, to try everything without photos of one's own."""

import bpy

from ..objectgs_addon import locations, running


class MakeDemo(bpy.types.Operator):
    bl_idname = "objectgs.make_demo"
    bl_label = "Make Demo Capture"
    bl_description = ("Let Blender render a table-top with objects as a capture, in the background (a minute or two), "
                      "and import it")
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, _context):
        if running.busy(locations.demo_folder()):
            cls.poll_message_set("The demo capture is being made")
            return False
        return True

    def execute(self, context):
        job = locations.demo_job()
        return running.submit(job, context.scene, self.report)


CLASSES = (MakeDemo,)
