# SPDX-License-Identifier: GPL-3.0-or-later
"""The Pick Object tool, which also labels and outlines the object under the mouse."""

from __future__ import annotations

from typing import Any

import blf
import bpy

from .. import drawing, scene

TOOL = "objectgs.pick"

_handler = None
_items: list[tuple[Any, Any]] = []
"""Keymaps and their items outside of the tool."""
_name = ""
_pointed_at: int | None = None
"""Session UID of the collection under the mouse; `_name` is the label of the object."""


class PickTool(bpy.types.WorkSpaceTool):
    bl_space_type = "VIEW_3D"
    bl_context_mode = "OBJECT"
    bl_idname = TOOL
    bl_label = "Pick Object"
    bl_description = (
        "Select the visible objects of a reconstruction.\n"
        "Shift adds or removes, dragging selects all objects in a box, Esc leaves the tool"
    )
    bl_icon = "ops.generic.select"
    bl_keymap = (
        ("objectgs.point_at", {"type": "MOUSEMOVE", "value": "ANY", "any": True}, None),
        ("objectgs.pick_object", {"type": "LEFTMOUSE", "value": "CLICK"}, None),
        (
            "objectgs.pick_object",
            {"type": "LEFTMOUSE", "value": "CLICK", "shift": True},
            {"properties": [("toggle", True)]},
        ),
        ("objectgs.pick_box", {"type": "LEFTMOUSE", "value": "CLICK_DRAG"}, None),
        (
            "objectgs.pick_box",
            {"type": "LEFTMOUSE", "value": "CLICK_DRAG", "shift": True},
            {"properties": [("mode", "ADD")]},
        ),
        (
            "objectgs.pick_box",
            {"type": "LEFTMOUSE", "value": "CLICK_DRAG", "ctrl": True},
            {"properties": [("mode", "SUBTRACT")]},
        ),
        ("wm.tool_set_by_id", {"type": "ESC", "value": "PRESS"}, {"properties": [("name", "builtin.select_box")]}),
    )

    def draw_cursor(context: bpy.types.Context, _tool: Any, place: Any) -> None:  # noqa: N805 - no self
        """Draw the label; Blender calls this with the mouse's position in the window."""
        if not _name:
            return
        font, scale = 0, context.preferences.system.ui_scale
        blf.size(font, 14 * scale)
        blf.enable(font, blf.SHADOW)
        blf.shadow(font, 3, 0.0, 0.0, 0.0, 0.9)
        blf.color(font, 1.0, 1.0, 1.0, 1.0)
        blf.position(font, place[0] + 16 * scale, place[1] - 20 * scale, 0)
        blf.draw(font, _name)
        blf.disable(font, blf.SHADOW)


def is_active(context: bpy.types.Context) -> bool:
    """Return whether the tool is active in the context's workspace."""
    tool = context.workspace.tools.from_space_view3d_mode("OBJECT", create=False)
    return tool is not None and tool.idname == TOOL


def point_at(hit: Any) -> None:
    """Label and outline the hit under the mouse; None removes label and outline, and so does the background."""
    global _name, _pointed_at
    if hit is not None and hit.collection is not None and scene.object_id_of(hit.collection) == 0:
        hit = None
    collection = None if hit is None else hit.collection
    _name = "" if hit is None else hit.name
    _pointed_at = None if collection is None else collection.session_uid
    drawing.point_at(collection)


def is_pointing() -> bool:
    """Return whether an object is labeled and outlined."""
    return bool(_name)


def _leave() -> None:
    """Remove label and outline once another tool is active, or the object is hidden or removed."""
    if not _name:
        return
    context = bpy.context
    collection = next((each for each in bpy.data.collections if each.session_uid == _pointed_at), None)
    parts = () if collection is None else collection.objects
    is_shown = _pointed_at is None or any(
        scene.kind_of(part) in ("splats", "mesh") and drawing.shown(part, context.view_layer, context.space_data)
        for part in parts
    )
    if not is_active(context) or not is_shown:
        point_at(None)


@bpy.app.handlers.persistent
def _file_loads(*_: Any) -> None:
    point_at(None)


def register() -> None:
    global _handler
    if not bpy.app.background:
        bpy.utils.register_tool(PickTool, after={"builtin.select_lasso"}, group=True)
        _handler = bpy.types.SpaceView3D.draw_handler_add(_leave, (), "WINDOW", "PRE_VIEW")
        bpy.app.handlers.load_pre.append(_file_loads)
        keymaps = bpy.context.window_manager.keyconfigs.addon.keymaps
        # Outside of the viewport, the tool's own keymap gets no events.
        everywhere = keymaps.new(name="Window", space_type="EMPTY", region_type="WINDOW")
        _items.append((everywhere, everywhere.keymap_items.new("objectgs.point_away", "MOUSEMOVE", "ANY", any=True)))
        # The same clicks as Blender's own selection, which goes on where no splats are hit.
        viewport = keymaps.new(name="3D View", space_type="VIEW_3D", region_type="WINDOW")
        for shift in (False, True):
            item = viewport.keymap_items.new("objectgs.click_object", "LEFTMOUSE", "CLICK", shift=shift)
            item.properties.toggle = shift
            _items.append((viewport, item))


def unregister() -> None:
    global _handler
    if _handler is not None:
        for keymap, item in _items:
            keymap.keymap_items.remove(item)
        _items.clear()
        bpy.app.handlers.load_pre.remove(_file_loads)
        bpy.types.SpaceView3D.draw_handler_remove(_handler, "WINDOW")
        bpy.utils.unregister_tool(PickTool)
        _handler = None
