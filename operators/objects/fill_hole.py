# SPDX-License-Identifier: GPL-3.0-or-later
"""Fill the hole that a removed or moved object leaves, or leave it as it was trained."""

import bpy
from bpy.props import BoolProperty

from ...backend.shared.formats.splat_ply import UNOBSERVED
from ...objectgs_addon import scene
from ...objectgs_addon.state import object_edits, object_list
from ..common import need
from ..common.reporting import reports_errors


class FillHole(bpy.types.Operator):
    bl_idname = "objectgs.fill_hole"
    bl_label = "Fill Hole"
    bl_description = (
        "Fill the hole that the removed or moved object leaves in the ground or wall from its surroundings. The "
        f'attribute "{UNOBSERVED}" marks these splats'
    )
    bl_options = {"REGISTER", "UNDO"}

    filled: BoolProperty(name="Filled", default=True, options={"SKIP_SAVE"})

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return cls.bl_description if properties.filled else "Leave the hole as it was trained"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not need.edited(cls, context):
            return False
        root = need.active_root(context)
        item = object_list.shown_item(root)
        collection = scene.object_collections(root).get(scene.from_stored(item.object_id))
        if item.removed or item.fill or (collection is not None and scene.is_moved(root, collection)):
            return True
        cls.poll_message_set(f"{item.name} is neither removed nor moved, so it leaves no hole")
        return False

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root = need.active_root(context)
        object_id = scene.from_stored(object_list.shown_item(root).object_id)
        object_edits.store_edits(root)  # The hole is that of an object that is stored as moved.
        object_edits.fill_hole(root, object_id, self.filled)


CLASSES = (FillHole,)
