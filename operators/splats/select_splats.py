# SPDX-License-Identifier: GPL-3.0-or-later
"""Select single splats in a viewport by a brush, a lasso, a box or a sphere."""

import math
from typing import Any

import bpy
import numpy as np

from ...backend.shared.splats.picking import View
from ...backend.shared.splats.regions import box_region, brush_region, lasso_region
from ...objectgs_addon.picking import hit_test, splat_selection, splats_tool
from ..common import need
from ..common.path import FollowsMouse, Points, rectangle
from ..common.reporting import reports_errors
from ..common.viewport import selection_mode


class SelectSplats(FollowsMouse, bpy.types.Operator):
    bl_idname = "objectgs.select_splats"
    bl_label = "Select Splats"
    bl_description = "Select single splats of the active reconstruction with the shape set in the tool"
    bl_options = {"REGISTER", "UNDO"}

    mode: selection_mode()

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return super().poll(context) and need.shown(cls, context)

    def keeps_path(self, context: bpy.types.Context) -> bool:
        return context.scene.objectgs.splat_shape in {"BRUSH", "LASSO"}

    def outline(self, points: Points) -> Points:
        shape = bpy.context.scene.objectgs.splat_shape
        if shape == "BOX":
            return rectangle(points)
        if shape == "SPHERE":
            return splats_tool.circle(*points[0], math.dist(points[0], points[-1]))
        return [*points, points[0]] if shape == "LASSO" else points

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        settings, root = context.scene.objectgs, need.active_root(context)
        view = hit_test.view_of(context)
        points = self.pixels(view.height)
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
