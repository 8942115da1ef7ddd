# SPDX-License-Identifier: GPL-3.0-or-later
"""Remove Object: make objects invisible until they are restored; duplicates go for good."""

import bpy
from bpy.props import BoolProperty

from ..backend.protocol import InputError
from ..objectgs_addon import messages, object_edits, scene, selection
from . import need


class RemoveObject(bpy.types.Operator):
    bl_idname = "objectgs.remove_object"
    bl_label = "Remove"
    bl_description = ("Make the objects selected in the viewport, or the active one of the list, invisible in "
                      "viewports, pictures and exports. Restore brings them back as they are. Duplicates are deleted")
    bl_options = {"REGISTER", "UNDO"}

    floaters: BoolProperty(name="Floaters Too",
                           description="Also what belongs to no object and lies inside the removed one")
    fill: BoolProperty(name="Fill", description="Close the ground or wall that the object hid with what is around it")

    @classmethod
    def poll(cls, context):
        return need.not_removed(cls, context, " already")

    def execute(self, context):
        root = need.active_root(context)
        selected = selection.selected_collections(context, root)
        copies = [collection for collection in selected if scene.kind_of(collection) == "object_copy"]
        ids = [scene.object_id_of(collection) for collection in selected if collection not in copies]
        ids = ids if selected else object_edits.chosen_ids(context, root)
        ids = [object_id for object_id in ids if object_edits.item_of(root, object_id)]
        if not ids and not copies:
            self.report({"ERROR"}, "What belongs to no object cannot be removed; hide it, or choose an object")
            return {"CANCELLED"}
        try:
            for copy in copies:
                scene.remove_copy(copy)
            if copies:
                object_edits.store_edits(root)
            if ids:
                object_edits.remove(root, ids, self.floaters, self.fill)
        except (InputError, OSError) as error:
            self.report({"ERROR"}, messages.sentence(error))
            return {"FINISHED"} if copies else {"CANCELLED"}
        return {"FINISHED"}


CLASSES = (RemoveObject,)
