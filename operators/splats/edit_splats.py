# SPDX-License-Identifier: GPL-3.0-or-later
"""Delete the selected splats, restore deleted ones, and move the selected ones to other objects."""

import bpy
from bpy.props import StringProperty

from ...backend.shared.errors import InputError
from ...objectgs_addon import scene
from ...objectgs_addon.picking import selection
from ...objectgs_addon.state import object_list, splat_edits
from ..common import need
from ..common.reporting import reports_errors


class DeleteSplats(bpy.types.Operator):
    bl_idname = "objectgs.delete_splats"
    bl_label = "Delete Splats"
    bl_description = "Hide the selected splats in viewports, renders and exports until they are restored"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        # All else is an error, since the key would go on to Blender's own operator, which deletes objects.
        return need.shown(cls, context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root = need.active_root(context)
        count = splat_edits.delete(root, splat_edits.shown_parts(context, root))
        self.report({"INFO"}, f"{_counted(count)} deleted")


class RestoreSplats(bpy.types.Operator):
    bl_idname = "objectgs.restore_splats"
    bl_label = "Restore Deleted"
    bl_description = "Restore all deleted splats of the active reconstruction"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.reconstruction(cls, context) and need.splats(cls, context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        self.report({"INFO"}, f"{_counted(splat_edits.restore(need.active_root(context)))} restored")


class ClearSplatEdits(bpy.types.Operator):
    bl_idname = "objectgs.clear_splat_edits"
    bl_label = "Clear Splat Edits"
    bl_description = (
        "Restore all splats of the active reconstruction to their objects: without deleted, assigned and cropped ones. "
        "This also drops edits that match no splat after further training"
    )
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.reconstruction(cls, context) and need.splats(cls, context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        splat_edits.clear(need.active_root(context))


class SeparateSplats(bpy.types.Operator):
    bl_idname = "objectgs.separate_splats"
    bl_label = "Separate Splats"
    bl_description = "Move the selected splats to a new object"
    bl_options = {"REGISTER", "UNDO"}

    name: StringProperty(
        name="Name", description="Name of the new object; if empty, that of its source", options={"SKIP_SAVE"}
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.objects(cls, context) and need.object_mode(cls, context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root = need.active_root(context)
        parts = splat_edits.shown_parts(context, root)
        name = " ".join(self.name.split()) or f"{_source(parts)} part"
        object_id = splat_edits.separate(root, parts, name)
        context.view_layer.update()
        selection.select_object(context, root, object_id)


class AssignSplats(bpy.types.Operator):
    bl_idname = "objectgs.assign_splats"
    bl_label = "Assign Splats"
    bl_description = "Move the selected splats to this object"
    bl_options = {"REGISTER", "UNDO"}

    object: StringProperty(name="Object", description="ID of the object; 0 for no object", options={"SKIP_SAVE"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.objects(cls, context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root = need.active_root(context)
        object_id = int(self.object) if self.object.isdecimal() else -1
        item = object_list.item_of(root, object_id)
        if object_id and (item is None or item.removed or not item.chosen):
            what = f"{item.name} is removed or left out" if item else f"There is no object {self.object}"
            raise InputError(f"{what}; choose another object")
        target = object_list.merge_target(root, object_id)
        count = splat_edits.assign(root, splat_edits.shown_parts(context, root), target)
        name = item.name if item else "no object"
        self.report({"INFO"}, f"{_counted(count)} assigned to {name}")


def _source(parts: list[bpy.types.Object]) -> str:
    """Return the name of the object that has most of the selected splats."""
    most = max(parts, key=lambda part: scene.selected_splats(part.data).sum(), default=None)
    collection = None if most is None else scene.collection_of(most)
    return "Background" if collection is None else collection.name


def _counted(count: int) -> str:
    return f"{count:,} splat{'' if count == 1 else 's'}"


CLASSES = (DeleteSplats, RestoreSplats, ClearSplatEdits, SeparateSplats, AssignSplats)
