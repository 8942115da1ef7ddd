# SPDX-License-Identifier: GPL-3.0-or-later
"""Choose which objects to reconstruct; the others stay part of the unlabelled rest."""

import bpy
from bpy.props import EnumProperty

from ..backend.protocol import InputError
from ..objectgs_addon import messages, object_edits, selection
from . import need


class ChooseObjects(bpy.types.Operator):
    bl_idname = "objectgs.choose_objects"
    bl_label = "Choose Objects"
    bl_description = "Choose which objects training makes; the rest is left out"
    bl_options = {"REGISTER", "UNDO"}

    which: EnumProperty(name="Which", items=[
        ("ALL", "All", "Make every object"), ("ACTIVE", "Only Active", "Make only the active object of the list"),
        ("SELECTED", "Only Selected", "Make only the objects that are selected in the viewport"),
        ("INVERT", "Invert", "Make those that are left out now")])

    @classmethod
    def poll(cls, context):
        return need.objects(cls, context) and need.idle(cls, context)

    def execute(self, context):
        root = need.active_root(context)
        rows = {object_edits.from_stored(item.object_id): item.chosen for item in root.objectgs.objects}
        active = object_edits.from_stored(object_edits.active_item(root).object_id)
        kept = {"ALL": set(rows), "ACTIVE": {active}, "SELECTED": set(selection.selected_ids(context, root)),
                "INVERT": {object_id for object_id, chosen in rows.items() if not chosen}}[self.which] & set(rows)
        if not kept:
            self.report({"ERROR"}, "No object would be left to make")
            return {"CANCELLED"}
        try:
            object_edits.choose(root, {object_id: object_id in kept for object_id in rows})
        except (InputError, OSError) as error:
            self.report({"ERROR"}, messages.sentence(error))
            return {"CANCELLED"}
        return {"FINISHED"}


CLASSES = (ChooseObjects,)
