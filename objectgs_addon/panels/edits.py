# SPDX-License-Identifier: GPL-3.0-or-later
"""What can be changed about an object: seen or not, its colours, its place."""

import math

import bpy
from mathutils import Matrix

from .. import object_edits, running, scene
from ..job_display import write
from .tab import WithReconstruction, draw_job_of


class EditPanel(WithReconstruction, bpy.types.Panel):
    bl_idname = "OBJECTGS_PT_edit"
    bl_label = "Edit"

    def draw(self, context):
        layout = self.layout
        root = context.scene.objectgs.active
        item = object_edits.shown_item(root)
        if item is None:
            write(layout, "Vote to find the objects.", "INFO")
            return
        collection = scene.object_collections(root).get(object_edits.from_stored(item.object_id))
        row = layout.row()
        row.label(text=item.name, icon="TRASH" if item.removed else "OUTLINER_COLLECTION")
        row = layout.row(align=True)
        if item.removed:
            row.operator("objectgs.restore_object", icon="LOOP_BACK")
            fill = row.operator("objectgs.close_place", icon="MOD_REMESH", depress=item.fill)
            fill.closed = not item.fill
            if item.fill:
                self._draw_fill(layout, root, collection)
        else:
            for text, floaters, fill in (("Remove", False, False), ("With Floaters", True, False),
                                         ("And Fill", False, True)):
                operator = row.operator("objectgs.remove_object", text=text)
                operator.floaters, operator.fill = floaters, fill
        layout.operator("objectgs.duplicate_object", icon="DUPLICATE")
        if collection is None:
            write(layout, "It has no splats and no mesh yet; train first.", "INFO")
            return
        self._draw_colours(layout, item)
        self._draw_place(layout, root, collection)

    def _draw_fill(self, layout, root, collection) -> None:
        count = None if collection is None else collection.get(scene.INVENTED_COUNT)
        job = running.job_of(root)
        if count:
            write(layout, f"{count:,} invented splats close its place", "CHECKMARK")
        elif count == 0:
            write(layout, "Nothing flat was found around it that could close its place", "INFO")
        elif job is not None and job.kind == "fill":
            draw_job_of(layout, job)

    def _draw_colours(self, layout, item) -> None:
        column = layout.column(align=True)
        row = column.row(align=True)
        row.prop(item, "replace", text="")
        row.prop(item, "amount")
        for name in ("hue", "saturation", "value", "contrast"):
            column.prop(item, name)
        column.row(align=True).prop(item, "tint")
        row = column.row()
        row.enabled = object_edits.recolour_of(item).changes
        row.operator("objectgs.reset_object", text="Reset Colors", icon="LOOP_BACK").what = "COLORS"

    def _draw_place(self, layout, root, collection) -> None:
        place = scene.place_of(root, collection)
        copies = len(scene.copies_of(root).get(scene.object_id_of(collection), ()))
        column = layout.column(align=True)
        moved = place is not None and not _is_identity(place)
        where = _described(root, collection, place) if moved else "Where it was captured"
        column.label(text=where, icon="OBJECT_ORIGIN")
        if copies:
            column.label(text=f"{copies} duplicate{'s' if copies > 1 else ''}", icon="DUPLICATE")
        row = column.row()
        row.enabled = moved
        row.operator("objectgs.reset_object", text="Reset Place", icon="LOOP_BACK").what = "PLACE"


def _is_identity(place) -> bool:
    return all(value == (i == j) for i, row in enumerate(place.tolist()) for j, value in enumerate(row))


def _described(root, collection, place) -> str:
    """Where an object went, in words: how far its middle, in Blender's lengths, turn and scale."""
    _, rotation, scale = Matrix(place.tolist()).decompose()
    turn = math.degrees(rotation.angle)
    turn = min(turn, 360.0 - turn)
    factor = abs(scale.x * scale.y * scale.z) ** (1.0 / 3.0)
    distance = scene.moved_by(root, collection)
    words = [f"Moved by {distance:.3g}" if distance else "Moved"]
    if turn > 0.05:
        words.append(f"turned by {turn:.1f}\u00b0")
    if abs(factor - 1.0) > 1e-4:
        words.append(f"scaled by {factor:.3g}")
    return ", ".join(words)
