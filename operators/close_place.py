# SPDX-License-Identifier: GPL-3.0-or-later
"""Fill Place: close what a removed object hid, or leave it as it was trained."""

import bpy

from ..backend.protocol import InputError
from ..objectgs_addon import messages, object_edits
from . import need


class ClosePlace(bpy.types.Operator):
    bl_idname = "objectgs.close_place"
    bl_label = "Fill"
    bl_description = ("Close the ground or wall that the removed object hid, with what is around it; the attribute "
                      "\"invented\" tells these splats")
    bl_options = {"REGISTER", "UNDO"}

    closed: bpy.props.BoolProperty(name="Filled", default=True, options={"SKIP_SAVE"})

    @classmethod
    def description(cls, _context, properties):
        return cls.bl_description if properties.closed else "Leave what the object hid as it was trained"

    @classmethod
    def poll(cls, context):
        if not need.edited(cls, context):
            return False
        item = object_edits.shown_item(need.active_root(context))
        if item.removed:
            return True
        cls.poll_message_set(f"{item.name} is not removed, so it hides what is behind it")
        return False

    def execute(self, context):
        root = need.active_root(context)
        object_id = object_edits.from_stored(object_edits.shown_item(root).object_id)
        try:
            object_edits.close_place(root, object_id, self.closed)
        except (InputError, OSError) as error:
            self.report({"ERROR"}, messages.sentence(error))
            return {"CANCELLED"}
        return {"FINISHED"}


CLASSES = (ClosePlace,)
