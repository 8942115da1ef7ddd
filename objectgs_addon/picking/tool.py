# SPDX-License-Identifier: GPL-3.0-or-later
"""The Pick Object tool, which also labels and highlights the object under the mouse."""

from __future__ import annotations

from typing import Any

import blf
import bpy
import gpu
from gpu_extras.batch import batch_for_shader
from mathutils import Vector

from .. import drawing, scene

TOOL = "objectgs.pick"
_EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))

_handler = None
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
        "Shift toggles, dragging selects all objects in a box, Esc leaves the tool"
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
    """Label and highlight the hit under the mouse; None removes label and highlight."""
    global _name, _pointed_at
    collection = None if hit is None else hit.collection
    _name = "" if hit is None else hit.name
    _pointed_at = None if collection is None else collection.session_uid
    drawing.point_at(collection)


def _draw() -> None:
    """Draw boxes around the parts under the mouse that the splat renderer does not highlight."""
    context = bpy.context
    if _pointed_at is None:
        return
    if not is_active(context):
        point_at(None)
        return
    kinds = ("mesh",) if context.scene.objectgs.draw_splats else ("mesh", "splats")
    lines = []
    for collection in bpy.data.collections:
        if collection.session_uid == _pointed_at:
            for part in collection.objects:
                if scene.kind_of(part) in kinds and drawing.shown(part, context.view_layer, context.space_data):
                    corners = [part.matrix_world @ Vector(corner) for corner in part.bound_box]
                    lines += [corners[end] for edge in _EDGES for end in edge]
    if lines:
        shader = gpu.shader.from_builtin("UNIFORM_COLOR")
        shader.uniform_float("color", (1.0, 1.0, 1.0, 1.0))
        batch_for_shader(shader, "LINES", {"pos": lines}).draw(shader)


@bpy.app.handlers.persistent
def _file_loads(*_: Any) -> None:
    point_at(None)


def register() -> None:
    global _handler
    if not bpy.app.background:
        bpy.utils.register_tool(PickTool, after={"builtin.select_lasso"})
        _handler = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")
        bpy.app.handlers.load_pre.append(_file_loads)


def unregister() -> None:
    global _handler
    if _handler is not None:
        bpy.app.handlers.load_pre.remove(_file_loads)
        bpy.types.SpaceView3D.draw_handler_remove(_handler, "WINDOW")
        bpy.utils.unregister_tool(PickTool)
        _handler = None
