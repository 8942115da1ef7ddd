# SPDX-License-Identifier: GPL-3.0-or-later
"""The list of objects with color, name, counts and visibility, filtered by name."""

from __future__ import annotations

from typing import Any

import bpy

from ... import scene
from ...running import background
from ...running.job_display import write
from ...state import folder_trust, visibility
from ...state.next_step import can_mark, has_masks
from ..tab import WithReconstruction, draw_job_of, draw_without_objects


class ObjectList(bpy.types.UIList):
    """Rows of `ObjectItem`."""

    bl_idname = "OBJECTGS_UL_objects"
    layers: dict[int, bpy.types.LayerCollection] = {}
    """Object ID -> layer collection, gathered once per redraw for all rows."""

    def draw_item(
        self,
        _context: bpy.types.Context,
        layout: bpy.types.UILayout,
        _properties: Any,
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
        name = row.row()
        name.active = item.chosen and not item.is_merged and not item.removed
        name.prop(item, "name", text="", emboss=False)
        numbers = row.row()
        numbers.alignment = "RIGHT"
        numbers.active = False
        numbers.label(text=_count(item))
        row.prop(item, "chosen", text="", icon="CHECKBOX_HLT" if item.chosen else "CHECKBOX_DEHLT", emboss=False)
        object_id = scene.from_stored(item.object_id)
        layer = ObjectList.layers.get(object_id)
        if item.removed:
            row.operator("objectgs.restore_object", text="", icon="TRASH", emboss=False).object = str(object_id)
        elif layer is None:
            row.label(text="", icon="LINKED" if item.is_merged else "BLANK1")
        else:
            row.prop(
                layer, "hide_viewport", text="", emboss=False, icon="HIDE_ON" if layer.hide_viewport else "HIDE_OFF"
            )

    def filter_items(self, context: bpy.types.Context, properties: Any, name: str) -> tuple[list[int], list[int]]:
        ObjectList.layers = visibility.object_layers(context.view_layer, properties.id_data)
        items = getattr(properties, name)
        helpers = bpy.types.UI_UL_list
        wanted = (
            helpers.filter_items_by_name(self.filter_name, self.bitflag_filter_item, items, "name")
            if self.filter_name
            else []
        )
        order = helpers.sort_items_by_name(items, "name") if self.use_filter_sort_alpha else []
        return wanted, order


class ObjectsPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_objects"
    bl_label = "Objects"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        root = context.scene.objectgs.active
        properties = root.objectgs
        job = background.job_of(root)
        state = folder_trust.state_of(root)
        kinds = ("vote", "masks") if can_mark(state) else ("vote", "masks", "label")
        if job is not None and job.kind in kinds and not (properties.objects and job.is_finished):
            draw_job_of(layout, job)
        if not properties.objects:
            draw_without_objects(layout, root)
        if has_masks(state):
            layout.operator("objectgs.assign_objects", icon="GROUP_VERTEX")
            if state.trained:
                layout.operator("objectgs.clean_up_labels", icon="BRUSH_DATA")
        if state.capture is not None:
            layout.operator("objectgs.import_masks", icon="IMAGE_ALPHA")
        if not properties.objects:
            return
        row = layout.row()
        row.template_list("OBJECTGS_UL_objects", "", properties, "objects", properties, "active_object", rows=8)
        column = row.column(align=True)
        column.operator("objectgs.select_object", text="", icon="RESTRICT_SELECT_OFF")
        column.operator("objectgs.select_by_name", text="", icon="VIEWZOOM")
        column.operator("objectgs.solo_object", text="", icon="SOLO_ON")
        column.separator()
        column.operator("objectgs.merge_objects", text="", icon="AUTOMERGE_ON")
        column.operator("objectgs.split_objects", text="", icon="UNLINKED")
        column.separator()
        column.operator_menu_enum("objectgs.choose_objects", "which", text="", icon="CHECKBOX_HLT")
        if 0 <= properties.active_object < len(properties.objects):
            write(layout, describe(properties.objects[properties.active_object], properties))
        left_out = sum(not item.chosen for item in properties.objects)
        if left_out:
            layout.label(text=f"{left_out} of {len(properties.objects)} are left out of training")
        layout.prop(context.scene.objectgs, "select_whole")


def describe(item: Any, properties: Any) -> str:
    """Return the name, which the row may cut off, the ID, counts and state of a row as text."""
    words = [item.name, f"ID {scene.from_stored(item.object_id)}", f"{item.points:,} points"]
    if item.splats:
        words.append(f"{item.splats:,} splats")
    if item.faces:
        words.append(f"{item.faces:,} faces")
    if item.removed:
        words.append("removed")
    if item.is_merged:
        into = next((other.name for other in properties.objects if other.object_id == item.merged_into), "?")
        words.append(f"part of {into}")
    return ", ".join(words)


def _count(item: Any) -> str:
    """Return the number of splats or, before training, of points."""
    return "" if item.is_merged else _abbreviate(item.splats or item.points)


def _abbreviate(count: int) -> str:
    return f"{count:,}" if count < 10_000 else f"{count / 1000:,.0f}k" if count < 1_000_000 else f"{count / 1e6:.1f}M"
