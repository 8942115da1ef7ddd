# SPDX-License-Identifier: GPL-3.0-or-later
"""Mark as Assets: each object's collection for the asset browser, standing on what it is dropped on."""

import bpy

from ..objectgs_addon import scene, selection
from . import need


class MarkAssets(bpy.types.Operator):
    bl_idname = "objectgs.mark_assets"
    bl_label = "Mark as Assets"
    bl_description = ("Offer the objects that have a mesh in the asset browser: those selected in the viewport, or "
                      "else all. They keep size and uprightness, and stand on what they are dropped on")
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if not need.objects(cls, context):
            return False
        if scene.object_meshes(need.active_root(context)):
            return True
        cls.poll_message_set("There are no meshes yet; extract them first")
        return False

    def execute(self, context):
        root = need.active_root(context)
        meshes = scene.object_meshes(root)
        selected = set(selection.selected_ids(context, root)) & set(meshes)
        collections = scene.object_collections(root)
        context.view_layer.update()
        for object_id in sorted(selected or meshes):
            scene.mark_asset(collections[object_id], meshes[object_id])
        self.report({"INFO"}, f"{len(selected or meshes)} objects are assets of this file")
        return {"FINISHED"}


CLASSES = (MarkAssets,)
