# SPDX-License-Identifier: GPL-3.0-or-later
"""Reset Object: take colours or place back to what was captured."""

import bpy
from bpy.props import EnumProperty

from ..backend.protocol import InputError
from ..objectgs_addon import messages, object_edits, scene
from . import need


class ResetObject(bpy.types.Operator):
    bl_idname = "objectgs.reset_object"
    bl_label = "Reset"
    bl_description = "Take the active object of the list back to what was captured"
    bl_options = {"REGISTER", "UNDO"}

    what: EnumProperty(name="What", items=[
        ("COLORS", "Colors", "Its own colors again"), ("PLACE", "Place", "Where it was captured again")])

    @classmethod
    def description(cls, _context, properties):
        return {"COLORS": "Give the active object its own colors back",
                "PLACE": "Move the active object back to where it was captured"}[properties.what]

    @classmethod
    def poll(cls, context):
        return need.edited(cls, context)

    def execute(self, context):
        root = need.active_root(context)
        object_id = object_edits.from_stored(object_edits.shown_item(root).object_id)
        try:
            if self.what == "COLORS":
                object_edits.reset_colours(root, [object_id])
            else:
                scene.reset_place(root, scene.object_collections(root)[object_id])
                object_edits.store_edits(root)
        except (InputError, OSError) as error:
            self.report({"ERROR"}, messages.sentence(error))
            return {"CANCELLED"}
        return {"FINISHED"}


CLASSES = (ResetObject,)
