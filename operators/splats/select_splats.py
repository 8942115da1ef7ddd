# SPDX-License-Identifier: GPL-3.0-or-later
"""Select single splats in a viewport by a brush, a lasso, a box or a sphere."""

import math
from typing import Any

import bpy
import gpu
import numpy as np
from bpy.props import CollectionProperty
from gpu_extras.batch import batch_for_shader

from ...backend.shared.splats.picking import View
from ...backend.shared.splats.regions import box_region, brush_region, lasso_region
from ...objectgs_addon.picking import hit_test, splat_selection, splats_tool
from ..common import need
from ..common.reporting import reports_errors
from ..common.viewport import InViewport, selection_mode

_SPACING = 2.0
"""Smallest distance in pixels of the positions of a path."""


class SelectSplats(InViewport, bpy.types.Operator):
    bl_idname = "objectgs.select_splats"
    bl_label = "Select Splats"
    bl_description = "Select single splats of the active reconstruction with the shape set in the tool"
    bl_options = {"REGISTER", "UNDO"}

    mode: selection_mode()
    path: CollectionProperty(type=bpy.types.OperatorMousePath, options={"HIDDEN", "SKIP_SAVE"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return super().poll(context) and need.shown(cls, context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.path.clear()
        self._append(context, event)
        self._append(context, event)
        self._handler = bpy.types.SpaceView3D.draw_handler_add(self._draw, (), "WINDOW", "POST_PIXEL")
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type in {"ESC", "RIGHTMOUSE"}:
            self._end(context)
            return {"CANCELLED"}
        if event.type in {"MOUSEMOVE", "INBETWEEN_MOUSEMOVE"}:
            self._move(context, event)
            context.area.tag_redraw()
        if event.type == "LEFTMOUSE" and event.value == "RELEASE":
            self._move(context, event)
            self._end(context)
            return self.execute(context)
        return {"RUNNING_MODAL"}

    def cancel(self, context: bpy.types.Context) -> None:
        self._end(context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        settings, root = context.scene.objectgs, need.active_root(context)
        view = hit_test.view_of(context)
        points = [(item.loc[0] + 0.5, view.height - item.loc[1] - 0.5) for item in self.path]
        parts = splat_selection.editable_parts(root, context.view_layer, context.space_data)
        occluders = splat_selection.occluders(context.view_layer, context.space_data)
        if settings.splat_shape == "SPHERE":
            test = splat_selection.within_sphere(*_sphere(context, view, occluders, points))
        else:
            region = _region(settings, view, points)
            test = splat_selection.within(view, region)
        if settings.splat_depth == "VISIBLE":
            test = splat_selection.only_visible(test, occluders, view)
        splat_selection.select(parts, test, self.mode)

    def _append(self, context: bpy.types.Context, event: bpy.types.Event) -> None:
        item = self.path.add()
        item.loc = event.mouse_x - context.region.x, event.mouse_y - context.region.y

    def _move(self, context: bpy.types.Context, event: bpy.types.Event) -> None:
        """Move the end of the path to the mouse, and keep where it was if the shape needs all of the path."""
        end, before = self.path[-1], self.path[-2]
        keeps = context.scene.objectgs.splat_shape in {"BRUSH", "LASSO"}
        if keeps and math.dist(end.loc, before.loc) >= _SPACING:
            self._append(context, event)
        else:
            end.loc = event.mouse_x - context.region.x, event.mouse_y - context.region.y

    def _end(self, context: bpy.types.Context) -> None:
        bpy.types.SpaceView3D.draw_handler_remove(self._handler, "WINDOW")
        context.area.tag_redraw()

    def _draw(self) -> None:
        settings = bpy.context.scene.objectgs
        points = [tuple(item.loc) for item in self.path]
        (left, bottom), (right, top) = points[0], points[-1]
        if settings.splat_shape == "BOX":
            lines = [(left, bottom), (right, bottom), (right, top), (left, top), (left, bottom)]
        elif settings.splat_shape == "SPHERE":
            lines = splats_tool.circle(left, bottom, math.dist(points[0], points[-1]))
        elif settings.splat_shape == "LASSO":
            lines = [*points, points[0]]
        else:
            lines = points
        shader = gpu.shader.from_builtin("UNIFORM_COLOR")
        shader.uniform_float("color", (1.0, 1.0, 1.0, 1.0))
        batch_for_shader(shader, "LINE_STRIP", {"pos": [(x, y, 0.0) for x, y in lines]}).draw(shader)


def _region(settings: Any, view: View, points: list[tuple[float, float]]) -> np.ndarray:
    """Return the pixels (height, width) of a view that a path of the mouse selects."""
    if settings.splat_shape == "BOX":
        return box_region(view.width, view.height, points[0], points[-1])
    if settings.splat_shape == "LASSO":
        return lasso_region(view.width, view.height, points)
    return brush_region(view.width, view.height, points, settings.splat_radius)


def _sphere(
    context: bpy.types.Context, view: View, occluders: list, points: list[tuple[float, float]]
) -> tuple[np.ndarray, float]:
    """Return the center (3,) and the radius of a sphere of the world around the surface under the start of a path."""
    x, y = points[0]
    depth = splat_selection.depth_at(occluders, view, x, y)
    if depth is None:
        depth = float(view.viewmat[2] @ [*context.region_data.view_location, 1.0])
    scale = (1.0 if view.orthographic else depth) / view.fx
    across, down = (x - view.cx) * scale, (y - view.cy) * scale
    return (np.linalg.inv(view.viewmat) @ [across, down, depth, 1.0])[:3], math.dist(points[0], points[-1]) * abs(scale)


CLASSES = (SelectSplats,)
