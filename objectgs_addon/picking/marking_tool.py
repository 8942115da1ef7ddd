# SPDX-License-Identifier: GPL-3.0-or-later
"""The Mark Object tool, which draws strokes on the objects of a reconstruction that has no masks."""

from __future__ import annotations

from typing import Any

import bpy

from . import marks, splats_tool

TOOL = "objectgs.mark"
_MARK = "objectgs.mark_object"

_registered = False


class MarkTool(bpy.types.WorkSpaceTool):
    bl_space_type = "VIEW_3D"
    bl_context_mode = "OBJECT"
    bl_idname = TOOL
    bl_label = "Mark Object"
    bl_description = (
        "Draw over an object to separate it from the scene; more strokes correct the result.\n"
        "Ctrl marks what belongs to no object, Tab begins the next object, Esc leaves the tool"
    )
    bl_icon = "ops.gpencil.draw"
    bl_keymap = (
        (_MARK, {"type": "LEFTMOUSE", "value": "PRESS"}, None),
        (_MARK, {"type": "LEFTMOUSE", "value": "PRESS", "ctrl": True}, {"properties": [("nothing", True)]}),
        ("objectgs.add_marked_object", {"type": "TAB", "value": "PRESS"}, None),
        ("wm.tool_set_by_id", {"type": "ESC", "value": "PRESS"}, {"properties": [("name", "builtin.select_box")]}),
    )

    def draw_settings(context: bpy.types.Context, layout: bpy.types.UILayout, _tool: Any) -> None:  # noqa: N805 - no self
        """Draw the tool's settings in the header."""
        layout.prop(context.scene.objectgs, "mark_shape", text="")
        root = context.scene.objectgs.active
        item = None if root is None else marks.active_object(root)
        if item is not None:
            row = layout.row(align=True)
            swatch = row.row()
            swatch.ui_units_x = 1.2
            swatch.prop(item, "color", text="")
            row.prop(item, "name", text="")
            layout.operator("objectgs.add_marked_object", text="Next", icon="ADD")


def activate(context: bpy.types.Context) -> None:
    """Make the tool active in the context's workspace, if its window shows a 3D viewport."""
    _use(context, TOOL)


def leave(context: bpy.types.Context) -> None:
    """Return to Blender's own selection if the tool is active."""
    tool = context.workspace.tools.from_space_view3d_mode("OBJECT", create=False) if context.workspace else None
    if tool is not None and tool.idname == TOOL:
        _use(context, "builtin.select_box")


def _use(context: bpy.types.Context, tool: str) -> None:
    for area in context.window.screen.areas if context.window else ():
        if area.type == "VIEW_3D":
            region = next(region for region in area.regions if region.type == "WINDOW")
            with context.temp_override(area=area, region=region):
                bpy.ops.wm.tool_set_by_id(name=tool)
            return


def register() -> None:
    global _registered
    if not bpy.app.background:
        bpy.utils.register_tool(MarkTool, after={splats_tool.TOOL}, group=True)
        _registered = True


def unregister() -> None:
    global _registered
    if _registered:
        bpy.utils.unregister_tool(MarkTool)
        _registered = False
