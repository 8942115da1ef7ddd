# SPDX-License-Identifier: GPL-3.0-or-later
"""Override a decision of the plan."""

import bpy
from bpy.props import StringProperty

from ...backend.shared.errors import InputError
from ...objectgs_addon.state import planning
from ..common import need
from ..common.reporting import reports_errors


class OverrideDecision(bpy.types.Operator):
    bl_idname = "objectgs.override_decision"
    bl_label = "Override This Decision"
    bl_description = "Do the opposite of what was planned"
    bl_options = {"REGISTER", "UNDO"}

    key: StringProperty(name="Decision", options={"HIDDEN", "SKIP_SAVE"}, description="Name of the decision")

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        decision = planning.plan_for(need.active_root(context))[properties.key]
        return cls.bl_description if decision is None else planning.sentence_case(decision.why)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.reconstruction(cls, context) and need.idle(cls, context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root = need.active_root(context)
        decision = planning.plan_for(root)[self.key]
        if decision is None or not decision.can_override:
            raise InputError(f"The plan leaves no choice about {self.key or 'nothing'}")
        planning.want(root.objectgs, self.key, not planning.is_wanted(root.objectgs, decision))


CLASSES = (OverrideDecision,)
