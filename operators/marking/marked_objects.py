# SPDX-License-Identifier: GPL-3.0-or-later
"""The list of marked objects, and their separation from the scene."""

from pathlib import Path

import bpy
from bpy.props import EnumProperty

from ...backend.shared.errors import InputError
from ...backend.shared.formats.json_file import write_json
from ...backend.shared.reconstruction.folder import Reconstruction
from ...objectgs_addon import scene
from ...objectgs_addon.environment import locations
from ...objectgs_addon.picking import marking_tool, marks
from ...objectgs_addon.running import background, pointing
from ..common import need
from ..common.jobs import LOST_EDITS, STARTS_JOB, loses_splat_edits
from ..common.reporting import reports_errors

_LISTED = 3
"""Largest number of objects that are named in a question."""


class _OfMarks:
    """Base of operators on the list of marked objects."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.shown(cls, context)


class AddMarkedObject(_OfMarks, bpy.types.Operator):
    bl_idname = "objectgs.add_marked_object"
    bl_label = "Next Object"
    bl_description = "Begin the next object; further strokes mark it"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        marks.add_object(need.active_root(context))
        pointing.redraw()
        return {"FINISHED"}


class RemoveMarkedObject(_OfMarks, bpy.types.Operator):
    bl_idname = "objectgs.remove_marked_object"
    bl_label = "Remove Marked Object"
    bl_description = "Remove the active object of the list with its strokes"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not super().poll(context):
            return False
        if marks.active_object(need.active_root(context)) is not None:
            return True
        cls.poll_message_set("No object is marked yet")
        return False

    def execute(self, context: bpy.types.Context) -> set[str]:
        root = need.active_root(context)
        marks.remove_object(root, root.objectgs.active_marked)
        return {"FINISHED"}


def _other_objects(_self: bpy.types.Operator, context: bpy.types.Context) -> list[tuple[str, str, str]]:
    properties = need.active_root(context).objectgs
    _other_objects.shown = [  # Blender keeps no reference to the texts.
        (str(index), item.name, "") for index, item in enumerate(properties.marked) if index != properties.active_marked
    ] or [("-1", "None", "")]
    return _other_objects.shown


class MergeMarked(_OfMarks, bpy.types.Operator):
    bl_idname = "objectgs.merge_marked"
    bl_label = "Merge Marked Objects"
    bl_description = "Make the active object of the list a part of another one"
    bl_options = {"REGISTER", "UNDO"}
    bl_property = "into"

    into: EnumProperty(name="Into", items=_other_objects, description="Object that the active one is a part of")

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not super().poll(context):
            return False
        if marks.active_object(need.active_root(context)) and len(need.active_root(context).objectgs.marked) > 1:
            return True
        cls.poll_message_set("Two marked objects are needed")
        return False

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        context.window_manager.invoke_search_popup(self)
        return {"INTERFACE"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        root = need.active_root(context)
        marks.merge_object(root, root.objectgs.active_marked, int(self.into))
        return {"FINISHED"}


class ClearMarks(_OfMarks, bpy.types.Operator):
    bl_idname = "objectgs.clear_marks"
    bl_label = "Remove All Marks"
    bl_description = "Remove all strokes and marked objects"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        marks.clear(need.active_root(context))
        return {"FINISHED"}


class SeparateMarked(_OfMarks, bpy.types.Operator):
    bl_idname = "objectgs.separate_marked"
    bl_label = "Separate Objects"
    bl_description = (
        "Give each marked object a collection of its own. After a training, the borders of the objects are trained "
        "for a short time, and masks of the photos are made"
    )
    bl_options = STARTS_JOB

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.markable(cls, context) and need.splats(cls, context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        names = marks.names_without_strokes(need.active_root(context))
        lost = [LOST_EDITS] if loses_splat_edits(context) else []
        if not names and not lost:
            return self.execute(context)
        title, sentences = "Lose Edits of Splats?", lost
        if names:
            title = f"{len(names)} Object{'s' if len(names) > 1 else ''} Without Strokes"
            listed = ", ".join([*names[:_LISTED], *(["..."] if len(names) > _LISTED else [])])
            sentences = [f"Only marked objects are kept; these become background: {listed}", *lost]
        return context.window_manager.invoke_confirm(
            self,
            event,
            title=title,
            message=". ".join(sentences),
            confirm_text="Separate Marked Objects",
            icon="WARNING",
        )

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = need.active_root(context)
        content = marks.content(root)
        if not any(stroke["object"] for stroke in content["strokes"]):
            raise InputError("No object is marked; draw over one with the tool Mark Object")
        folder = scene.folder_of(root)
        strokes: Path = Reconstruction(folder).strokes
        write_json(strokes, content)
        job = locations.backend_job(
            f"Separate objects of {root.name}",
            "label",
            folder,
            "label",
            str(folder),
            "--strokes",
            str(strokes),
            *locations.segmenter_options(pointing.segmenter(root)),
        )
        # A click then selects the object that it has become.
        marking_tool.leave(context)
        return background.submit(job, context.scene, self.report)


CLASSES = (AddMarkedObject, RemoveMarkedObject, MergeMarked, ClearMarks, SeparateMarked)
