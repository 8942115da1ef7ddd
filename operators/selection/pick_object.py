# SPDX-License-Identifier: GPL-3.0-or-later
"""Select visible objects in a viewport by a click or a box, and outline the one under the mouse."""

import time

import bpy
from bpy.props import BoolProperty, IntProperty

from ...objectgs_addon import scene
from ...objectgs_addon.picking import hit_test, selection
from ...objectgs_addon.picking import tool as pick_tool
from ..common.path import draw_line, rectangle
from ..common.viewport import InViewport, selection_mode

_HIDDEN = {"HIDDEN", "SKIP_SAVE"}
_PAUSE = 1.0
"""Pause after a lookup under the mouse, relative to its duration, so that redraws keep up."""


class PickObject(InViewport, bpy.types.Operator):
    bl_idname = "objectgs.pick_object"
    bl_label = "Pick Object"
    bl_description = "Select the object under the mouse, whether it shows splats or a mesh"
    bl_options = {"REGISTER", "UNDO"}

    toggle: BoolProperty(
        name="Toggle", description="Add the object to the selection, or remove it", options={"SKIP_SAVE"}
    )
    x: IntProperty(name="X", description="Pixels from the left of the viewport", options=_HIDDEN)
    y: IntProperty(name="Y", description="Pixels from the bottom of the viewport", options=_HIDDEN)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.x, self.y = event.mouse_region_x, event.mouse_region_y
        return self.execute(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        hit = hit_test.object_at(context, self.x, self.y)
        if hit is not None:
            _select(context, hit, self.toggle)
        elif not self.toggle:
            selection.select_nothing(context)
        return {"FINISHED"}


def _parts(hit: hit_test.Hit) -> list[bpy.types.Object]:
    """Return the Blender objects to select of what was hit."""
    return [hit.obj] if hit.collection is None else selection.parts_to_select(hit.collection)


def _select(context: bpy.types.Context, hit: hit_test.Hit, toggle: bool) -> None:
    """Select what was hit; with `toggle`, add it to the selection, or remove it."""
    parts = _parts(hit)
    if toggle and parts and all(part.select_get() for part in parts):
        for part in parts:
            part.select_set(False)
    elif hit.collection is not None:
        selection.select_collections(context, [hit.collection], toggle)
    else:
        if not toggle:
            selection.select_nothing(context)
        hit.obj.select_set(True)
        context.view_layer.objects.active = hit.obj


class ClickObject(InViewport, bpy.types.Operator):
    bl_idname = "objectgs.click_object"
    bl_label = "Select Drawn Splats"
    bl_description = "Select the object whose drawn splats are under the mouse, which Blender's own tools do not see"
    bl_options = {"INTERNAL", "UNDO"}

    toggle: BoolProperty(name="Toggle", options={"SKIP_SAVE"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        is_there = context.region_data is not None and context.mode == "OBJECT"
        return is_there and hit_test.draws_splats(context) and scene.is_in_file()

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        hit = hit_test.object_at(context, event.mouse_region_x, event.mouse_region_y, needs_splats=True)
        if hit is None or not hit_test.is_drawn(context, hit):
            return {"PASS_THROUGH"}
        _select(context, hit, self.toggle)
        return {"FINISHED"}


class PickBox(InViewport, bpy.types.Operator):
    bl_idname = "objectgs.pick_box"
    bl_label = "Pick Objects in Box"
    bl_description = "Select the objects that are visible in a box"
    bl_options = {"REGISTER", "UNDO"}

    mode: selection_mode()
    left: IntProperty(options=_HIDDEN)
    bottom: IntProperty(options=_HIDDEN)
    right: IntProperty(options=_HIDDEN)
    top: IntProperty(options=_HIDDEN)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self._region = region = context.region
        self._from = event.mouse_prev_press_x - region.x, event.mouse_prev_press_y - region.y
        self._to = event.mouse_region_x, event.mouse_region_y
        self._handler = bpy.types.SpaceView3D.draw_handler_add(self._draw, (), "WINDOW", "POST_PIXEL")
        context.window_manager.modal_handler_add(self)
        pick_tool.point_at(None)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type in {"ESC", "RIGHTMOUSE"}:
            self._end(context)
            return {"CANCELLED"}
        if event.type == "MOUSEMOVE":
            self._to = event.mouse_region_x, event.mouse_region_y
            context.area.tag_redraw()
        if event.type == "LEFTMOUSE" and event.value == "RELEASE":
            self._to = event.mouse_region_x, event.mouse_region_y
            self._end(context)
            (self.left, self.right), (self.bottom, self.top) = (sorted(ends) for ends in zip(self._from, self._to))
            return self.execute(context)
        return {"RUNNING_MODAL"}

    def cancel(self, context: bpy.types.Context) -> None:
        self._end(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        found = hit_test.objects_in(context, self.left, self.bottom, self.right + 1, self.top + 1)
        # The background is in nearly every box.
        hits = [hit for hit in found if hit.collection is None or scene.object_id_of(hit.collection) != 0]
        if self.mode == "SET":
            selection.select_nothing(context)
        found_parts = [parts for hit in hits if (parts := _parts(hit))]
        for part in (part for parts in found_parts for part in parts):
            part.select_set(self.mode != "SUBTRACT")
        if found_parts and self.mode != "SUBTRACT":
            selection.activate(context, found_parts[-1])
        return {"FINISHED"}

    def _end(self, context: bpy.types.Context) -> None:
        bpy.types.SpaceView3D.draw_handler_remove(self._handler, "WINDOW")
        context.area.tag_redraw()

    def _draw(self) -> None:
        if bpy.context.region == self._region:
            draw_line(rectangle([self._from, self._to]))


class PointAt(InViewport, bpy.types.Operator):
    bl_idname = "objectgs.point_at"
    bl_label = "Point at Object"
    bl_description = "Show the name of the object under the mouse and outline it"
    bl_options = {"INTERNAL"}

    _next = 0.0

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        began, was_labeled = time.monotonic(), pick_tool.is_pointing()
        if began >= PointAt._next:
            pick_tool.point_at(hit_test.object_at(context, event.mouse_region_x, event.mouse_region_y))
            now = time.monotonic()
            PointAt._next = now + _PAUSE * (now - began)
        if was_labeled or pick_tool.is_pointing():
            context.area.tag_redraw()
        return {"PASS_THROUGH"}


class PointAway(bpy.types.Operator):
    bl_idname = "objectgs.point_away"
    bl_label = "Point away from Object"
    bl_description = "Remove the outline of the object that was under the mouse before it left the viewport"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        return pick_tool.is_pointing()

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if not hit_test.is_in_viewport(context.window, event.mouse_x, event.mouse_y):
            pick_tool.point_at(None)
        return {"PASS_THROUGH"}


CLASSES = (PickObject, ClickObject, PickBox, PointAt, PointAway)
