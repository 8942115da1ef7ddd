# SPDX-License-Identifier: GPL-3.0-or-later
"""Mark objects by strokes in a viewport."""

import bpy
from bpy.props import BoolProperty

from ...objectgs_addon.picking import hit_test, marking_tool, marks
from ...objectgs_addon.running import pointing
from ..common import need
from ..common.path import FollowsMouse, Points, rectangle
from ..common.reporting import reports_errors


class StartMarking(bpy.types.Operator):
    bl_idname = "objectgs.start_marking"
    bl_label = "Mark Objects"
    bl_description = "Separate objects without masks: draw over each of them with the tool Mark Object"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.markable(cls, context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root = need.active_root(context)
        pointing.start(root)
        if marks.active_object(root) is None:
            marks.add_object(root)
        marking_tool.activate(context)


class SuggestObjects(bpy.types.Operator):
    bl_idname = "objectgs.suggest_objects"
    bl_label = "Suggest Objects"
    bl_description = (
        "Find objects by the shape of the scene, such as things on a table, and mark them; this takes seconds and "
        "replaces all marks"
    )
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.markable(cls, context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        pointing.propose(need.active_root(context))
        marking_tool.activate(context)


class StopMarking(bpy.types.Operator):
    bl_idname = "objectgs.stop_marking"
    bl_label = "Stop Marking"
    bl_description = "Show the splats in their own colors again; the strokes are kept"
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not need.shown(cls, context):
            return False
        if pointing.is_active(need.active_root(context)):
            return True
        cls.poll_message_set("Objects are not being marked; use Mark Objects first")
        return False

    def execute(self, context: bpy.types.Context) -> set[str]:
        pointing.stop()
        marking_tool.leave(context)
        return {"FINISHED"}


class MarkObject(FollowsMouse, bpy.types.Operator):
    bl_idname = "objectgs.mark_object"
    bl_label = "Mark Object"
    bl_description = "Mark the active object of the list by a stroke over it"
    bl_options = {"REGISTER", "UNDO"}

    nothing: BoolProperty(
        name="No Object", options={"SKIP_SAVE"}, description="Mark what belongs to no object, or not to this one"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return super().poll(context) and need.markable(cls, context)

    def keeps_path(self, context: bpy.types.Context) -> bool:
        return context.scene.objectgs.mark_shape != "BOX"

    def outline(self, points: Points) -> Points:
        shape = bpy.context.scene.objectgs.mark_shape
        return rectangle(points) if shape == "BOX" else [*points, points[0]] if shape == "LASSO" else points

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root, shape = need.active_root(context), context.scene.objectgs.mark_shape
        pointing.start(root)
        item = marks.active_object(root) or marks.add_object(root)
        view = hit_test.view_of(context)
        points = self.pixels(view.height)
        corners = rectangle(points)[:-1] if shape == "BOX" else points
        object_id = marks.NOTHING if self.nothing else item.object_id
        marks.add_stroke(root, object_id, view, corners, area=shape != "STROKE")


CLASSES = (StartMarking, SuggestObjects, StopMarking, MarkObject)
