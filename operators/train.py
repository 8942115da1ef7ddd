# SPDX-License-Identifier: GPL-3.0-or-later
"""Train: make the splats, in the background."""

import bpy
from bpy.props import BoolProperty

from ..objectgs_addon import locations, planning, running, scene
from ..objectgs_addon.folder_state import folder_state
from . import need


class Train(bpy.types.Operator):
    bl_idname = "objectgs.train"
    bl_label = "Train"
    bl_description = "Make the splats in the background; goes on where an earlier training stopped"
    bl_options = {"REGISTER"}

    restart: BoolProperty(name="Train Anew", options={"SKIP_SAVE"},
                          description="Forget the training that is there and begin again")

    @classmethod
    def description(cls, _context, properties):
        return "Forget the training that is there and begin again" if properties.restart else cls.bl_description

    @classmethod
    def poll(cls, context):
        return need.work_on_capture(cls, context)

    def invoke(self, context, event):
        if self.restart:
            return context.window_manager.invoke_confirm(self, event)
        return self.execute(context)

    def execute(self, context):
        root = need.active_root(context)
        properties = root.objectgs
        folder = scene.folder_of(root)
        state = folder_state(folder)
        by_clock = properties.length == "minutes"
        if by_clock and not self.restart and state.trained and state.seconds >= 60.0 * properties.minutes:
            self.report({"ERROR"}, f"It was trained for {state.seconds / 60:.1f} minutes already; raise Minutes to "
                                   "extend the training, or use Train Anew")
            return {"CANCELLED"}
        length = ("--minutes", f"{properties.minutes:g}") if by_clock else ("--preset", properties.length)
        arguments = ["train", str(state.capture), "--out", str(folder), *length, *planning.arguments(root)]
        if self.restart:
            arguments.append("--restart")
        job = locations.backend_job(f"Train {root.name}", "train", folder, *arguments)
        return running.submit(job, context.scene, self.report)


CLASSES = (Train,)
