# SPDX-License-Identifier: GPL-3.0-or-later
"""Hide the floaters of objects, or show them again."""

import bpy
from bpy.props import BoolProperty

from ...backend.shared.errors import InputError
from ...objectgs_addon import scene
from ...objectgs_addon.state import object_edits, object_list
from ..common import need
from ..common.reporting import reports_errors


class CleanFloaters(bpy.types.Operator):
    bl_idname = "objectgs.clean_floaters"
    bl_label = "Clean Floaters"
    bl_options = {"REGISTER", "UNDO"}

    everything: BoolProperty(
        name="All Objects", description="Of all objects of the list, selected or not", options={"SKIP_SAVE"}
    )
    restore: BoolProperty(name="Restore", description="Show the floaters again", options={"SKIP_SAVE"})

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        which = "all objects" if properties.everything else "the objects selected in the viewport, or the active one"
        if properties.restore:
            return f"Show the floaters of {which} again"
        return (
            f"Hide the floaters of {which} in viewports, renders and exports: splats far from the rest of the object, "
            "and small groups of splats apart from it"
        )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.shown_objects(cls, context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root = need.active_root(context)
        counts = scene.floater_counts(root)
        if self.everything:
            items = root.objectgs.objects
            ids = [object_id for item in items if (object_id := scene.from_stored(item.object_id)) in counts]
        else:
            ids = object_list.require_chosen_ids(context, root)
            if not set(ids) & set(scene.object_collections(root)):
                raise InputError(need.why_not_shown(root, object_list.shown_item(root)))
        object_edits.clean_floaters(root, ids, not self.restore)
        count = sum(counts.get(object_id, 0) for object_id in ids)
        what = f"floaters of {len(ids)} object{'s' if len(ids) != 1 else ''} {'shown' if self.restore else 'hidden'}"
        self.report({"INFO"}, f"{count:,} {what}")


CLASSES = (CleanFloaters,)
