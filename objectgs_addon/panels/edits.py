# SPDX-License-Identifier: GPL-3.0-or-later
"""Edits of an object: remove, restore, duplicate, recolor and move."""

from __future__ import annotations

import math
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from .. import scene
from ..picking import selection
from ..process.jobs import State
from ..running import background
from ..running.job_display import write
from ..state import object_list
from .tab import WithReconstruction, draw_job_of


class EditPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_edit"
    bl_label = "Edit"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        root = context.scene.objectgs.active
        item = object_list.shown_item(root)
        if item is None:
            write(layout, "There are no objects yet.", "INFO")
            return
        object_id = scene.from_stored(item.object_id)
        collection = scene.object_collections(root).get(object_id)
        duplicate = selection.active_duplicate(context, root, object_id)
        name = item.name if duplicate is None else f"{duplicate.name} (duplicate of {item.name})"
        several = [] if item.removed else selection.selected_collections(context, root)[1:]
        heading = f"{len(several) + 1} selected objects" if several else name
        layout.label(text=heading, icon="TRASH" if item.removed else "OUTLINER_COLLECTION")
        if item.removed:
            row = layout.row(align=True)
            row.operator("objectgs.restore_object", icon="LOOP_BACK")
            self._draw_fill(layout, row, root, item, collection)
        else:
            column = layout.column(align=True)
            for text, floaters, fill in (
                ("Remove", False, False),
                ("Remove with Leftovers", True, False),
                ("Remove and Fill", False, True),
            ):
                operator = column.operator("objectgs.remove_object", text=text)
                operator.floaters, operator.fill = floaters, fill
        row = layout.row(align=True)
        clean = row.operator(
            "objectgs.clean_floaters", text="Restore Floaters" if item.cleaned else "Clean Floaters", icon="BRUSH_DATA"
        )
        clean.restore, clean.everything = item.cleaned, False
        row.operator("objectgs.clean_floaters", text="All").everything = True
        layout.operator("objectgs.duplicate_object", icon="DUPLICATE")
        if collection is None:
            write(layout, "This object has no splats and no mesh yet; train first.", "INFO")
            return
        if several:
            layout.label(text=name, icon="OUTLINER_COLLECTION")
        count = len(scene.duplicates_of(root).get(object_id, []))
        if count:
            write(layout, f"Colors of {item.name} and its {f'{count} duplicates' if count > 1 else 'duplicate'}")
        self._draw_colors(layout, item)
        self._draw_transform(layout, root, duplicate or collection)
        if not item.removed and (item.fill or scene.is_moved(root, collection)):
            self._draw_fill(layout, layout.row(), root, item, collection)

    def _draw_fill(
        self,
        layout: bpy.types.UILayout,
        row: bpy.types.UILayout,
        root: bpy.types.Collection,
        item: Any,
        collection: bpy.types.Collection | None,
    ) -> None:
        """Draw in a row whether the hole that an object leaves is filled, and below it with what."""
        fill = row.operator("objectgs.fill_hole", icon="MOD_REMESH", depress=item.fill)
        fill.filled = not item.fill
        if not item.fill:
            return
        count = None if collection is None else collection.get(scene.UNOBSERVED_COUNT)
        job = background.fill_of(root)
        running = background.queue.running
        if count:
            write(layout, f"{count:,} splats fill the hole", "CHECKMARK")
        elif count == 0:
            write(layout, "No flat surface was found around the hole to fill it", "INFO")
        elif job is not None and job.state is State.WAITING and running is not None:
            write(layout, f"The hole is filled when {running.title} has ended; stop it to fill it now.", "TIME")
        elif job is not None:
            draw_job_of(layout, job)

    def _draw_colors(self, layout: bpy.types.UILayout, item: Any) -> None:
        column = layout.column(align=True)
        row = column.row(align=True)
        row.prop(item, "replace", text="")
        row.prop(item, "amount")
        for name in ("hue", "saturation", "value", "contrast"):
            column.prop(item, name)
        column.row(align=True).prop(item, "tint")
        row = column.row()
        row.enabled = object_list.recolor_of(item).changes
        row.operator("objectgs.reset_object", text="Reset Colors", icon="LOOP_BACK").what = "COLORS"

    def _draw_transform(
        self, layout: bpy.types.UILayout, root: bpy.types.Collection, collection: bpy.types.Collection
    ) -> None:
        """Draw where an object or duplicate is."""
        place = scene.placement_of(root, collection)
        column = layout.column(align=True)
        moved = scene.is_moved(root, collection)
        where = _describe_transform(root, collection, place) if place is not None and moved else "Not moved"
        column.label(text=where, icon="OBJECT_ORIGIN")
        row = column.row()
        row.enabled = moved
        row.operator("objectgs.reset_object", text="Reset Transform", icon="LOOP_BACK").what = "TRANSFORM"


def _describe_transform(root: bpy.types.Collection, collection: bpy.types.Collection, place: np.ndarray) -> str:
    """Return an object's transform as text: distance of its center in Blender units, rotation angle and scale."""
    _, rotation, scale = Matrix(place.tolist()).decompose()
    turn = math.degrees(rotation.angle)
    turn = min(turn, 360.0 - turn)
    factor = abs(scale.x * scale.y * scale.z) ** (1.0 / 3.0)
    distance = scene.distance_moved(root, collection)
    words = [f"Moved by {distance:.3g}" if distance else "Moved"]
    if turn > 0.05:
        words.append(f"rotated by {turn:.1f}\u00b0")
    if abs(factor - 1.0) > 1e-4:
        words.append(f"scaled by {factor:.3g}")
    return ", ".join(words)


def draw_context_menu(menu: Any, context: bpy.types.Context) -> None:
    """Draw, in the context menu of objects, the edits of the reconstruction's object that the active one belongs to."""
    part = context.active_object
    object_id = scene.object_id_of(part) if part is not None else None
    if not object_id or scene.root_of(part, context.scene) is None:
        return
    layout = menu.layout
    layout.label(text="ObjectGS")
    for text, floaters, fill in (("Remove", False, False), ("Remove and Fill", False, True)):
        operator = layout.operator("objectgs.remove_object", text=text)
        operator.floaters, operator.fill = floaters, fill
    layout.operator("objectgs.clean_floaters").everything = False
    layout.operator("objectgs.duplicate_object")
    layout.operator("objectgs.solo_object")
    layout.operator("objectgs.extract_meshes")
    layout.separator()
