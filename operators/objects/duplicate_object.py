# SPDX-License-Identifier: GPL-3.0-or-later
"""Duplicate objects; a duplicate shares the splats, the mesh and the colors."""

import bpy

from ...backend.shared.errors import InputError
from ...objectgs_addon import scene
from ...objectgs_addon.picking import selection
from ...objectgs_addon.state import object_edits, object_list
from ..common import need
from ..common.reporting import reports_errors


class DuplicateObject(bpy.types.Operator):
    bl_idname = "objectgs.duplicate_object"
    bl_label = "Duplicate"
    bl_description = (
        "Duplicate the objects selected in the viewport, or the active one of the list, in place, and select the "
        "duplicates. They take little memory, are kept when training continues, and appear in renders and exports"
    )
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.not_removed(cls, context, "; restore it first") and need.object_mode(cls, context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root = need.active_root(context)
        object_edits.store_edits(root)  # Earlier changes have an undo step of their own, without the duplicates.
        known = {scene.from_stored(item.object_id) for item in root.objectgs.objects}
        wanted = selection.selected_collections(context, root) or [
            scene.object_collections(root)[object_id] for object_id in object_list.chosen_ids(context, root)
        ]
        wanted = [collection for collection in wanted if scene.object_id_of(collection) in known]
        if not wanted:
            raise InputError("The background cannot be duplicated; choose an object")
        duplicates = [scene.duplicate(root, collection) for collection in wanted]
        try:
            object_edits.store_edits(root)
        except (InputError, OSError):
            for duplicate in duplicates:
                scene.remove_duplicate(duplicate)
            raise
        selection.select_collections(context, duplicates)


CLASSES = (DuplicateObject,)
