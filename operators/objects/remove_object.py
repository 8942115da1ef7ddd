# SPDX-License-Identifier: GPL-3.0-or-later
"""Remove objects with their duplicates until they are restored; selected duplicates are deleted."""

import bpy
from bpy.props import BoolProperty

from ...backend.shared.errors import InputError
from ...objectgs_addon import scene
from ...objectgs_addon.blender import messages
from ...objectgs_addon.picking import selection
from ...objectgs_addon.state import object_edits, object_list
from ..common import need
from ..common.reporting import reports_errors


class RemoveObject(bpy.types.Operator):
    bl_idname = "objectgs.remove_object"
    bl_label = "Remove"
    bl_description = (
        "Remove the objects selected in the viewport, or the active one of the list, from "
        "viewports, renders and exports, with all of their duplicates. Restore brings them back unchanged. Selected "
        "duplicates are deleted"
    )
    bl_options = {"REGISTER", "UNDO"}

    floaters: BoolProperty(
        name="With Floaters", description="Also remove the background's splats inside the removed objects"
    )
    fill: BoolProperty(
        name="Fill Hole", description="Fill the hole in the ground or wall behind the object from its surroundings"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.not_removed(cls, context, " already")

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root = need.active_root(context)
        object_edits.store_edits(root)  # Earlier changes have an undo step of their own.
        selected = selection.selected_collections(context, root)
        duplicates = [collection for collection in selected if scene.kind_of(collection) == "object_copy"]
        ids = [scene.object_id_of(collection) for collection in selected if collection not in duplicates]
        ids = ids if selected else object_list.chosen_ids(context, root)
        ids = [object_id for object_id in ids if object_list.item_of(root, object_id)]
        if not ids and not duplicates:
            raise InputError("The background cannot be removed; hide it, or choose an object")
        try:
            for duplicate in duplicates:
                scene.remove_duplicate(duplicate)
            if duplicates:
                object_edits.store_edits(root)
            if ids:
                object_edits.remove(root, ids, self.floaters, self.fill)
        except (InputError, OSError) as error:
            if not duplicates:
                raise
            self.report({"ERROR"}, messages.sentence(error))  # Deleted duplicates need an undo step.


CLASSES = (RemoveObject,)
