# SPDX-License-Identifier: GPL-3.0-or-later
"""Choose which objects to reconstruct; the others stay part of the background."""

from collections.abc import Iterable

import bpy
from bpy.props import EnumProperty

from ...backend.shared.errors import InputError
from ...objectgs_addon import scene
from ...objectgs_addon.picking import selection
from ...objectgs_addon.state import object_edits, object_list
from ..common import need
from ..common.reporting import reports_errors


class ChooseObjects(bpy.types.Operator):
    bl_idname = "objectgs.choose_objects"
    bl_label = "Choose Objects"
    bl_description = "Choose which objects to train; the others are left out"
    bl_options = {"REGISTER", "UNDO"}

    which: EnumProperty(
        name="Which",
        items=[
            ("ALL", "All", "Train every object"),
            ("ACTIVE", "Only Active", "Train only the active object of the list"),
            ("SELECTED", "Only Selected", "Train only the objects selected in the viewport"),
            ("INVERT", "Invert", "Train the objects that are left out now, and leave out the others"),
        ],
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.objects(cls, context) and need.idle(cls, context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root = need.active_root(context)
        rows = {scene.from_stored(item.object_id): item.chosen for item in root.objectgs.objects}
        active = scene.from_stored(object_list.active_item(root).object_id)
        targets = object_list.merge_targets(root)

        def with_merged(chosen: Iterable[int]) -> set[int]:
            wanted = {targets.get(object_id) for object_id in chosen}
            return {object_id for object_id, target in targets.items() if target in wanted}

        kept = {
            "ALL": set(rows),
            "ACTIVE": with_merged([active]),
            "SELECTED": with_merged(selection.selected_ids(context, root)),
            "INVERT": {object_id for object_id, chosen in rows.items() if not chosen},
        }[self.which] & set(rows)
        if not kept:
            raise InputError("No object would be left to train; keep at least one checked")
        object_edits.choose(root, {object_id: object_id in kept for object_id in rows})


CLASSES = (ChooseObjects,)
