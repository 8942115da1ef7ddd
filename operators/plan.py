# SPDX-License-Identifier: GPL-3.0-or-later
"""Plan: what training will do and leave out, and what the user wants otherwise."""

from pathlib import Path

import bpy
from bpy.props import StringProperty

from ..backend.protocol import InputError
from ..objectgs_addon import locations, messages, object_edits, planning, running, scene
from ..objectgs_addon.folder_state import folder_state
from . import need


class MakePlan(bpy.types.Operator):
    bl_idname = "objectgs.plan"
    bl_label = "Plan"
    bl_description = "Look what training needs and what it can do without, with these settings and chosen objects"
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context):
        return need.work_on_capture(cls, context)

    def execute(self, context):
        root = need.active_root(context)
        folder = scene.folder_of(root)
        job = locations.backend_job(f"Plan {root.name}", "plan", folder, "plan", str(folder_state(folder).capture),
                                    "--out", str(folder), *planning.arguments(root))
        return running.submit(job, context.scene, self.report)


class OverrideDecision(bpy.types.Operator):
    bl_idname = "objectgs.override_decision"
    bl_label = "Override"
    bl_description = "Have this otherwise than planned"
    bl_options = {"REGISTER", "UNDO"}

    key: StringProperty(name="Decision", options={"HIDDEN", "SKIP_SAVE"}, description="Its name in the plan")

    @classmethod
    def description(cls, context, properties):
        decision = planning.plan_of(scene.folder_of(need.active_root(context)))[properties.key]
        return cls.bl_description if decision is None else planning.sentence_case(decision.why)

    @classmethod
    def poll(cls, context):
        return need.reconstruction(cls, context) and need.idle(cls, context)

    def execute(self, context):
        root = need.active_root(context)
        decision = planning.plan_of(scene.folder_of(root))[self.key]
        if decision is None or not decision.can_override:
            self.report({"ERROR"}, f"The plan leaves no choice about {self.key or 'nothing'}")
            return {"CANCELLED"}
        planning.want(root.objectgs, self.key, not planning.is_wanted(root.objectgs, decision))
        return {"FINISHED"}


class GroupObjects(bpy.types.Operator):
    bl_idname = "objectgs.group_objects"
    bl_label = "Group by File"
    bl_description = "Make one object of all IDs to which a labels file gives the same name, such as \"chair\""
    bl_options = {"REGISTER", "UNDO"}

    filepath: StringProperty(name="Labels", subtype="FILE_PATH", description="JSON file with IDs and names")
    filter_glob: StringProperty(default="*.json", options={"HIDDEN"})

    @classmethod
    def poll(cls, context):
        return need.objects(cls, context) and need.idle(cls, context)

    def invoke(self, context, _event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        try:
            object_edits.group(need.active_root(context), Path(bpy.path.abspath(self.filepath)))
        except (InputError, OSError) as error:
            self.report({"ERROR"}, messages.sentence(error))
            return {"CANCELLED"}
        return {"FINISHED"}


CLASSES = (MakePlan, OverrideDecision, GroupObjects)
