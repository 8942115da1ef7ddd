# SPDX-License-Identifier: GPL-3.0-or-later
"""The Select Splats tool, and the selected splats in viewports that do not draw splats."""

from __future__ import annotations

import math
from typing import Any

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from .. import drawing
from ..drawing.shaders import SELECTED_COLOR
from ..drawing.splat_arrays import arrays_of
from . import tool as pick_tool
from .hit_test import draws_splats

TOOL = "objectgs.select_splats"
_SELECT = "objectgs.select_splats"
_SEGMENTS = 48

_handler = None
_batches: dict[int, tuple[np.ndarray, Any]] = {}
"""Session UID of a mesh -> its selection, and the points of the selected splats."""


def _key(kind: str, **modifiers: bool) -> dict[str, Any]:
    return {"type": kind, "value": "PRESS", **modifiers}


def _action(name: str) -> dict[str, Any]:
    return {"properties": [("action", name)]}


class SelectSplatsTool(bpy.types.WorkSpaceTool):
    bl_space_type = "VIEW_3D"
    bl_context_mode = "OBJECT"
    bl_idname = TOOL
    bl_label = "Select Splats"
    bl_description = (
        "Select single splats of the active reconstruction by a brush, a lasso, a box or a sphere.\n"
        "Shift adds, Ctrl subtracts, F changes the brush, X deletes the selected splats, Esc leaves the tool"
    )
    bl_icon = "ops.generic.select_circle"
    bl_keymap = (
        (_SELECT, _key("LEFTMOUSE"), None),
        (_SELECT, _key("LEFTMOUSE", shift=True), {"properties": [("mode", "ADD")]}),
        (_SELECT, _key("LEFTMOUSE", ctrl=True), {"properties": [("mode", "SUBTRACT")]}),
        ("objectgs.select_all_splats", _key("A"), _action("SELECT")),
        ("objectgs.select_all_splats", _key("A", alt=True), _action("DESELECT")),
        ("objectgs.select_all_splats", _key("I", ctrl=True), _action("INVERT")),
        ("objectgs.grow_splats", _key("NUMPAD_PLUS", ctrl=True), None),
        ("objectgs.shrink_splats", _key("NUMPAD_MINUS", ctrl=True), None),
        ("objectgs.delete_splats", _key("X"), None),
        ("objectgs.delete_splats", _key("DEL"), None),
        ("wm.radial_control", _key("F"), {"properties": [("data_path_primary", "scene.objectgs.splat_radius")]}),
        ("wm.tool_set_by_id", _key("ESC"), {"properties": [("name", "builtin.select_box")]}),
    )

    def draw_settings(context: bpy.types.Context, layout: bpy.types.UILayout, _tool: Any) -> None:  # noqa: N805 - no self
        """Draw the tool's settings in the header."""
        settings = context.scene.objectgs
        layout.prop(settings, "splat_shape", text="")
        row = layout.row()
        row.active = settings.splat_shape == "BRUSH"
        row.prop(settings, "splat_radius")
        layout.row().prop(settings, "splat_depth", expand=True)

    def draw_cursor(context: bpy.types.Context, _tool: Any, place: Any) -> None:  # noqa: N805 - no self
        """Draw the brush; Blender calls this with the mouse's position in the window."""
        settings = context.scene.objectgs
        if settings.splat_shape == "BRUSH":
            shader = gpu.shader.from_builtin("UNIFORM_COLOR")
            shader.uniform_float("color", (1.0, 1.0, 1.0, 0.8))
            outline = [(x, y, 0.0) for x, y in circle(place[0], place[1], settings.splat_radius)]
            batch_for_shader(shader, "LINE_STRIP", {"pos": outline}).draw(shader)


def circle(x: float, y: float, radius: float) -> list[tuple[float, float]]:
    """Return a closed outline of a circle, in the units of its center and radius."""
    angles = (2.0 * math.pi * i / _SEGMENTS for i in range(_SEGMENTS + 1))
    return [(x + radius * math.cos(angle), y + radius * math.sin(angle)) for angle in angles]


def _draw() -> None:
    """Draw the centers of the selected splats, which the preview of splats does not highlight."""
    context = bpy.context
    if draws_splats(context) or not context.space_data.overlay.show_overlays:
        return
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    for part in drawing.splat_parts(context.view_layer, context.space_data):
        selected = drawing.selected_of(part.data)
        if selected is None:
            continue
        uid = part.data.session_uid
        if uid not in _batches or _batches[uid][0] is not selected:
            centers = arrays_of(part.data).means[selected]
            _batches[uid] = selected, batch_for_shader(shader, "POINTS", {"pos": centers})
        with gpu.matrix.push_pop():
            gpu.matrix.multiply_matrix(part.matrix_world)
            gpu.state.point_size_set(2.0)
            shader.uniform_float("color", (*SELECTED_COLOR, 1.0))
            _batches[uid][1].draw(shader)


def register() -> None:
    global _handler
    if not bpy.app.background:
        bpy.utils.register_tool(SelectSplatsTool, after={pick_tool.TOOL}, group=True)
        _handler = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")


def unregister() -> None:
    global _handler
    if _handler is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handler, "WINDOW")
        bpy.utils.unregister_tool(SelectSplatsTool)
        _handler = None
    _batches.clear()
