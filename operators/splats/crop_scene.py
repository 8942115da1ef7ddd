# SPDX-License-Identifier: GPL-3.0-or-later
"""Crop a reconstruction to a box that the user moves."""

import bpy

from ...objectgs_addon import scene
from ...objectgs_addon.picking import selection
from ...objectgs_addon.state import splat_edits
from ..common import need
from ..common.reporting import reports_errors


class _OnSplats:
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.reconstruction(cls, context) and need.splats(cls, context)


class AddCropBox(_OnSplats, bpy.types.Operator):
    bl_idname = "objectgs.add_crop_box"
    bl_label = "Crop Box"
    bl_description = (
        "Add a box around the selected splats or, if there are none, around all objects, or show that of the present "
        "crop. Move, rotate and scale it, then apply the crop"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return super().poll(context) and need.object_mode(cls, context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root = need.active_root(context)
        box = scene.add_crop_box(root, splat_edits.crop_of(root))
        selection.select_nothing(context)
        box.select_set(True)
        context.view_layer.objects.active = box


class ApplyCrop(_OnSplats, bpy.types.Operator):
    bl_idname = "objectgs.apply_crop"
    bl_label = "Apply Crop"
    bl_description = (
        "Hide all splats outside of the crop box in viewports, renders and exports. Objects that were moved are "
        "cropped as they were captured. The crop is kept when training continues"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not super().poll(context):
            return False
        if scene.crop_box_of(need.active_root(context)) is not None:
            return True
        cls.poll_message_set("There is no crop box; use Crop Box first")
        return False

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root = need.active_root(context)
        box = scene.crop_box_of(root)
        splat_edits.crop(root, scene.box_of(root, box))
        bpy.data.objects.remove(box)


class RemoveCrop(_OnSplats, bpy.types.Operator):
    bl_idname = "objectgs.remove_crop"
    bl_label = "Remove Crop"
    bl_description = "Show the splats outside of the crop again"

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        splat_edits.crop(need.active_root(context), None)


CLASSES = (AddCropBox, ApplyCrop, RemoveCrop)
