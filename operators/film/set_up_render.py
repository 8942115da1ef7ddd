# SPDX-License-Identifier: GPL-3.0-or-later
"""Set up the scene to render splats in their captured colors."""

import bpy
import gpu

from ...objectgs_addon import scene
from ..common import need
from ..common.reporting import reports_errors


class SetUpRender(bpy.types.Operator):
    bl_idname = "objectgs.set_up_render"
    bl_label = "Set Up Render"
    bl_description = (
        "Set the scene's view transform to Standard, which keeps the colors of the photos, let rays pass through many "
        "splats in Cycles, and use the resolution of the photos. A selected camera of the capture becomes the "
        "scene's camera"
    )
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.shown(cls, context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        active = context.active_object
        chosen = active if active is not None and active.select_get() else None
        camera = scene.set_up_render(context.scene, need.active_root(context), chosen)
        render = context.scene.render
        size = f", with the resolution of {camera.name}" if camera is not None else ""
        text = f"{context.scene.name} renders captured colors at {render.resolution_x} x {render.resolution_y}{size}"
        if not bpy.app.background and gpu.platform.device_type_get() == "SOFTWARE":
            text += "; without a graphics card this takes many minutes, and Render Film Frames is faster"
        self.report({"INFO"}, text)
        return {"FINISHED"}


CLASSES = (SetUpRender,)
