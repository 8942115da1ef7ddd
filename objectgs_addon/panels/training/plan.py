# SPDX-License-Identifier: GPL-3.0-or-later
"""The decisions on what training does and leaves out, with their reasons."""

from __future__ import annotations

from typing import Any

import bpy

from ....backend.shared.reconstruction.plan import Decision
from ...running import background
from ...running.job_display import write
from ...state import planning
from ...state.planning import sentence_case
from ..tab import WithReconstruction


class PlanPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_plan"
    bl_label = "Plan"
    bl_parent_id = "OBJECTGS_PT_train"
    bl_options = {"DEFAULT_CLOSED"}

    def draw_header_preset(self, context: bpy.types.Context) -> None:
        root = context.scene.objectgs.active
        wanted = [planning.is_wanted(root.objectgs, decision) for decision in planning.plan_for(root).decisions]
        skipped = wanted.count(False)
        if skipped:
            self.layout.label(text=f"{skipped} part{'s' if skipped > 1 else ''} skipped")

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        root = context.scene.objectgs.active
        layout.enabled = not background.is_busy(root)
        for decision in planning.plan_for(root).decisions:
            _draw_decision(layout, root.objectgs, decision)
        row = layout.row(align=True)
        row.operator("objectgs.analyze_capture", icon="FILE_REFRESH")
        row.operator("objectgs.group_objects", icon="OUTLINER_OB_GROUP_INSTANCE")


def _draw_decision(layout: bpy.types.UILayout, properties: Any, decision: Decision) -> None:
    """Draw a decision as a row, with its reason unless it is carried out."""
    done = planning.is_wanted(properties, decision)
    row = layout.row(align=True)
    if decision.can_override and done is not None:
        row.operator(
            "objectgs.override_decision", text="", emboss=False, icon="CHECKBOX_HLT" if done else "CHECKBOX_DEHLT"
        ).key = decision.key
    else:
        row.label(text="", icon={True: "CHECKMARK", False: "X", None: "TIME"}[done])
    column = row.column(align=True)
    write(column, sentence_case(decision.what))
    if not done:
        reason = column.column(align=True)
        reason.active = False
        write(reason, sentence_case(decision.why))
