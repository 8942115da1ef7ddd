# SPDX-License-Identifier: GPL-3.0-or-later
"""Restore Object: bring a removed object back."""

import bpy
from bpy.props import StringProperty

from ..backend.protocol import InputError
from ..objectgs_addon import messages, object_edits
from . import need


class RestoreObject(bpy.types.Operator):
    bl_idname = "objectgs.restore_object"
    bl_label = "Restore"
    bl_description = "Bring a removed object back, exactly as it was, with the floaters that went with it"
    bl_options = {"REGISTER", "UNDO"}

    object: StringProperty(name="Object", description="Its ID; without one, the active one of the list",
                           options={"HIDDEN", "SKIP_SAVE"})

    @classmethod
    def poll(cls, context):
        if not need.objects(cls, context):
            return False
        if any(item.removed for item in need.active_root(context).objectgs.objects):
            return True
        cls.poll_message_set("No object is removed")
        return False

    def execute(self, context):
        root = need.active_root(context)
        item = object_edits.item_of(root, int(self.object)) if self.object else object_edits.shown_item(root)
        if item is None or not item.removed:
            self.report({"ERROR"}, f"{item.name if item else self.object} is not removed; choose one that is")
            return {"CANCELLED"}
        try:
            object_edits.restore(root, [object_edits.from_stored(item.object_id)])
        except (InputError, OSError) as error:
            self.report({"ERROR"}, messages.sentence(error))
            return {"CANCELLED"}
        return {"FINISHED"}


CLASSES = (RestoreObject,)
