# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects that are marked by strokes."""

from __future__ import annotations

from typing import Any

import bpy

from ... import drawing
from ...picking import marks
from ...running import background, pointing
from ...running.job_display import write
from ...state import folder_trust
from ...state.next_step import can_mark
from ..tab import WithReconstruction, draw_job_of

_ROWS = 4
"""Rows of the state of the marking, whatever it says."""


class MarkedList(bpy.types.UIList):
    """Rows of `MarkedObject`."""

    bl_idname = "OBJECTGS_UL_marked"

    def draw_item(
        self,
        _context: bpy.types.Context,
        layout: bpy.types.UILayout,
        properties: Any,
        item: Any,
        _icon: int,
        _active: Any,
        _property: str,
        _index: int = 0,
        _flag: int = 0,
    ) -> None:
        row = layout.row(align=True)
        swatch = row.row()
        swatch.ui_units_x = 0.8
        swatch.prop(item, "color", text="")
        row.prop(item, "name", text="", emboss=False)
        numbers = row.row()
        numbers.alignment = "RIGHT"
        numbers.active = False
        count = marks.count(properties.id_data, item.object_id)
        numbers.label(text=f"{count} stroke{'s' if count != 1 else ''}" if count else "not marked")


class MarkingPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_marking"
    bl_label = "Mark Objects"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not super().poll(context):
            return False
        root = context.scene.objectgs.active
        return folder_trust.is_accepted(root) and can_mark(folder_trust.state_of(root))

    def draw(self, context: bpy.types.Context) -> None:
        layout, root = self.layout, context.scene.objectgs.active
        properties = root.objectgs
        job = background.job_of(root)
        if job is not None and job.kind == "label":
            draw_job_of(layout, job)
        is_active = pointing.is_active(root)
        if not is_active:
            column = layout.column(align=True)
            column.operator("objectgs.start_marking", icon="GREASEPENCIL")
            _draw_suggesting(column, properties)
            if not properties.marked:
                write(layout, _how_to_begin(folder_trust.state_of(root).trained))
                return
        else:
            self._draw_state(layout, root)
            if folder_trust.state_of(root).trained and (hidden := _why_hidden(context)):
                write(layout, hidden, "HIDE_ON")
        if (model := pointing.segmenter(root)) is not None:
            write(layout, f"A stroke marks all that {model.name} segments by it.", "INFO")
        # Names that are changed now would not be those of the objects that it makes.
        is_fixed = job is not None and job.kind == "label" and not job.is_finished
        if is_active or not properties.objects:
            _draw_list(layout, properties, is_fixed)
        else:
            # The list of objects above has the same names.
            header, body = layout.panel("OBJECTGS_marked", default_closed=True)
            header.label(text="Marked Objects")
            if body is not None:
                _draw_list(body, properties, is_fixed)
        if is_active:
            _draw_suggesting(layout, properties)
        layout.prop(properties, "everything")
        layout.operator("objectgs.separate_marked", icon="CHECKMARK")
        if not folder_trust.state_of(root).trained:
            write(layout, "The strokes are kept. Train, and separate the objects then.", "INFO")
        if is_active:
            layout.operator("objectgs.stop_marking", icon="X")

    def _draw_state(self, layout: bpy.types.UILayout, root: bpy.types.Collection) -> None:
        progress, waits = pointing.state()
        if progress < 1.0:
            layout.progress(factor=progress, text=f"{100 * progress:.0f} %")
            text = pointing.message()
            if pointing.waiting_strokes(root):
                text = f"{text}. Strokes are applied when this is done; press Tab for the next object."
            write(layout, text, rows=_ROWS - 1)
            return
        item, nothing = marks.active_object(root), marks.count(root, marks.NOTHING)
        strokes = marks.strokes_of(root)
        marked = {stroke["object"] for stroke in strokes} - {marks.NOTHING}
        if waits:
            text = "Finding the objects"
        elif not strokes:
            text = f"Draw over {item.name if item else 'an object'} in the viewport."
        elif not nothing and len(marked) == 1:
            # The border between two things is found best where both are marked.
            text = "Press Tab to mark what it stands on, too. Hold Ctrl and draw where the color is on something else."
        elif not nothing:
            text = "Press Tab for the next object. Hold Ctrl and draw where the color is on something else."
        else:
            text = f"Press Tab for the next object. {nothing} stroke{'s' if nothing != 1 else ''} on no object."
        write(layout, text, "INFO", rows=_ROWS)


def _how_to_begin(is_trained: bool) -> str:
    if not is_trained:
        return "Train first: marks are found best on splats. Strokes drawn now are kept."
    return "Draw over each object in the viewport to separate it from the scene, or let them be found."


def _why_hidden(context: bpy.types.Context) -> str:
    """Return why a viewport does not show the marks on splats, and what to do; "" if it shows them."""
    if not context.scene.objectgs.draw_splats:
        return "The marks are not shown; switch Draw Splats on in the panel ObjectGS."
    if reason := drawing.failure():
        return f"The marks are not shown: {reason}"
    if context.space_data is not None and not context.space_data.overlay.show_overlays:
        return "The marks are not shown; switch the viewport's overlays on."
    return ""


def _draw_list(layout: bpy.types.UILayout, properties: Any, is_fixed: bool) -> None:
    row = layout.row()
    row.enabled = not is_fixed
    row.template_list("OBJECTGS_UL_marked", "", properties, "marked", properties, "active_marked", rows=4)
    column = row.column(align=True)
    column.operator("objectgs.add_marked_object", text="", icon="ADD")
    column.operator("objectgs.remove_marked_object", text="", icon="REMOVE")
    column.operator("objectgs.merge_marked", text="", icon="AUTOMERGE_ON")
    column.separator()
    column.operator("objectgs.clear_marks", text="", icon="TRASH")


def _draw_suggesting(layout: bpy.types.UILayout, properties: Any) -> None:
    column = layout.column(align=True)
    column.operator("objectgs.suggest_objects", icon="LIGHT")
    column.prop(properties, "detail", slider=True)
