# SPDX-License-Identifier: GPL-3.0-or-later
"""View and shading of the 3D viewports."""

from __future__ import annotations

import contextlib
from typing import Any

import bpy

from .. import drawing, scene
from . import object_list


def show(root: bpy.types.Collection) -> None:
    """Frame the cameras in every 3D viewport of a reconstruction's scene, and show color attributes in Solid mode."""
    for window in bpy.context.window_manager.windows:
        if root not in window.scene.collection.children_recursive:
            continue
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.spaces.active.shading.color_type = "VERTEX"
                region = next(region for region in area.regions if region.type == "WINDOW")
                with bpy.context.temp_override(window=window, area=area, region=region):
                    _frame(root)


def hide_points(root: bpy.types.Collection) -> None:
    """Hide the point cloud when splats or meshes replace it."""
    points = [part for part in root.all_objects if scene.kind_of(part) == "points"]
    for layer in (layer for owner in object_list.scenes_of(root) for layer in owner.view_layers):
        for part in points:
            # No lookup in the layer, which does not list newly linked objects yet.
            with contextlib.suppress(RuntimeError):  # The layer does not contain the points.
                part.hide_set(True, view_layer=layer)


def colors_changed(properties: Any, _context: bpy.types.Context = None) -> None:
    """Show points and splats of a scene in the colors of its setting.

    Without Draw Splats, the viewport's shading chooses the colors of the preview: that of the objects in Solid mode.
    """
    owner = properties.id_data
    for root in owner.collection.children_recursive:
        if scene.kind_of(root) == "reconstruction":
            scene.color_points_by(root, properties.colors)
    shading = {"photo": "MATERIAL", "object": "SOLID"}
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D" and window.scene == owner and not properties.draw_splats:
                space = area.spaces.active
                if space.shading.type in shading.values():
                    space.shading.type = shading[properties.colors]
    drawing.redraw()


def _frame(root: bpy.types.Collection) -> None:
    """Frame the cameras in the context's viewport and keep the selection."""
    context = bpy.context
    selected = list(context.selected_objects)
    for obj in selected:
        obj.select_set(False)
    wanted = [part for part in root.all_objects if scene.kind_of(part) == "camera" and part.visible_get()]
    for part in wanted:
        part.select_set(True)
    if wanted:
        bpy.ops.view3d.view_selected()
    for part in wanted:
        part.select_set(False)
    for obj in selected:
        obj.select_set(True)
