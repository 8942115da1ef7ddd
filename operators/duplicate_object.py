# SPDX-License-Identifier: GPL-3.0-or-later
"""Duplicate Object: one more of it, which shares the splats, the mesh and the colours."""

import bpy

from ..backend.protocol import InputError
from ..objectgs_addon import messages, object_edits, scene, selection
from . import need


class DuplicateObject(bpy.types.Operator):
    bl_idname = "objectgs.duplicate_object"
    bl_label = "Duplicate"
    bl_description = ("Make one more of the objects selected in the viewport, or of the active one of the list, in the "
                      "same place and selected, ready to be moved. It takes little memory, is kept when the object is "
                      "trained further, and takes part in pictures and exports")
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        return need.not_removed(cls, context, "; restore it first")

    def execute(self, context):
        root = need.active_root(context)
        known = {object_edits.from_stored(item.object_id) for item in root.objectgs.objects}
        wanted = selection.selected_collections(context, root) or [
            scene.object_collections(root)[object_id] for object_id in object_edits.chosen_ids(context, root)]
        wanted = [collection for collection in wanted if scene.object_id_of(collection) in known]
        if not wanted:
            self.report({"ERROR"}, "What belongs to no object cannot be duplicated; choose an object")
            return {"CANCELLED"}
        copies = [scene.duplicate(root, collection) for collection in wanted]
        try:
            object_edits.store_edits(root)
        except (InputError, OSError) as error:
            for copy in copies:
                scene.remove_copy(copy)
            self.report({"ERROR"}, messages.sentence(error))
            return {"CANCELLED"}
        selection.select_collections(context, copies)
        return {"FINISHED"}


CLASSES = (DuplicateObject,)
