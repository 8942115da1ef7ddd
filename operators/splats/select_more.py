# SPDX-License-Identifier: GPL-3.0-or-later
"""Select all single splats or none, invert the selection, grow and shrink it."""

from typing import Any

import bpy
from bpy.props import EnumProperty, FloatProperty

from ...objectgs_addon.picking import splat_selection
from ...objectgs_addon.state import splat_edits
from ..common import need
from ..common.reporting import reports_errors


class SelectAllSplats(bpy.types.Operator):
    bl_idname = "objectgs.select_all_splats"
    bl_label = "Select All Splats"
    bl_description = "Select all shown splats of the active reconstruction, none of them, or the others"
    bl_options = {"REGISTER", "UNDO"}

    action: EnumProperty(
        name="Action",
        items=[
            ("SELECT", "Select", "Select all splats"),
            ("DESELECT", "Deselect", "Deselect all splats"),
            ("INVERT", "Invert", "Invert the selection of splats"),
        ],
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.shown(cls, context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        parts = splat_edits.shown_parts(context, need.active_root(context))
        if self.action == "INVERT":
            splat_selection.invert(parts)
        else:
            splat_selection.select(parts, splat_selection.everything, "SET" if self.action == "SELECT" else "SUBTRACT")


class _WithDistance:
    bl_options = {"REGISTER", "UNDO"}
    poll_message_set: Any

    distance: FloatProperty(
        name="Distance",
        description="Distance between splats; 0 for one that suits their size",
        min=0.0,
        subtype="DISTANCE",
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.shown(cls, context)

    def parts_and_distance(self, context: bpy.types.Context) -> tuple[list[bpy.types.Object], float]:
        """Return the carriers of the shown splats, and the distance, which is set if it was 0."""
        parts = splat_edits.shown_parts(context, need.active_root(context))
        self.distance = self.distance or splat_selection.usual_distance(parts)
        return parts, self.distance


class GrowSplats(_WithDistance, bpy.types.Operator):
    bl_idname = "objectgs.grow_splats"
    bl_label = "Grow Splat Selection"
    bl_description = "Select the splats around the selected ones, too"

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        splat_selection.grow(*self.parts_and_distance(context))


class ShrinkSplats(_WithDistance, bpy.types.Operator):
    bl_idname = "objectgs.shrink_splats"
    bl_label = "Shrink Splat Selection"
    bl_description = "Deselect the splats at the border to those that are not selected"

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        splat_selection.shrink(*self.parts_and_distance(context))


CLASSES = (SelectAllSplats, GrowSplats, ShrinkSplats)
