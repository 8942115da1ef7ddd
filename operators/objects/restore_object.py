# SPDX-License-Identifier: GPL-3.0-or-later
"""Restore a removed object."""

import bpy
from bpy.props import StringProperty

from ...backend.shared.errors import InputError
from ...objectgs_addon import scene
from ...objectgs_addon.picking import selection
from ...objectgs_addon.state import object_edits, object_list
from ..common import need
from ..common.reporting import reports_errors


class RestoreObject(bpy.types.Operator):
    bl_idname = "objectgs.restore_object"
    bl_label = "Restore"
    bl_description = "Restore a removed object unchanged, with the floaters that were removed with it"
    bl_options = {"REGISTER", "UNDO"}

    object: StringProperty(
        name="Object",
        description="ID of the object; if empty, the active one of the list",
        options={"HIDDEN", "SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not need.objects(cls, context):
            return False
        if any(item.removed for item in need.active_root(context).objectgs.objects):
            return True
        cls.poll_message_set("No object is removed")
        return False

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root = need.active_root(context)
        item = object_list.item_of(root, int(self.object)) if self.object else object_list.shown_item(root)
        if item is None or not item.removed:
            raise InputError(f"{item.name if item else self.object} is not removed; choose one that is")
        object_id = scene.from_stored(item.object_id)
        object_edits.restore(root, [object_id])
        context.view_layer.update()  # Otherwise, the parts do not count as visible yet.
        selection.select_object(context, root, object_id)


CLASSES = (RestoreObject,)
