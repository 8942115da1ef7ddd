# SPDX-License-Identifier: GPL-3.0-or-later
"""What the 3D viewports look at."""

import bpy

from . import scene


def frame(root) -> None:
    """Let every 3D viewport of the windows that show a reconstruction's scene look at its cameras and points."""
    for window in bpy.context.window_manager.windows:
        if root not in window.scene.collection.children_recursive:
            continue
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                region = next(region for region in area.regions if region.type == "WINDOW")
                with bpy.context.temp_override(window=window, area=area, region=region):
                    _frame_in_context(root)


def _frame_in_context(root) -> None:
    context = bpy.context
    selected = list(context.selected_objects)
    for thing in selected:
        thing.select_set(False)
    wanted = [part for part in root.all_objects if scene.kind_of(part) == "camera" and part.visible_get()]
    for part in wanted:
        part.select_set(True)
    if wanted:
        bpy.ops.view3d.view_selected()
    for part in wanted:
        part.select_set(False)
    for thing in selected:
        thing.select_set(True)
