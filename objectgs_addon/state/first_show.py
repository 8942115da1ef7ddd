# SPDX-License-Identifier: GPL-3.0-or-later
"""A reconstruction shown in a scene for the first time: settings for renders, and fewer lines in the viewports."""

from __future__ import annotations

from pathlib import Path

import bpy

from .. import scene


def show_first(owner: bpy.types.Scene, folder: Path) -> bpy.types.Collection:
    """Show the cameras and points of a folder in a scene that does not show them yet, and return the collection.

    Blender's startup scene is set up for renders through the capture's first camera. The settings of any other scene
    are the user's.

    Raises:
        InputError: The folder's files cannot be used; nothing is changed.
    """
    untouched, related = scene.is_untouched(owner), any(obj.parent is not None for obj in owner.objects)
    root = scene.show_capture(owner, folder)
    if untouched:
        scene.set_up_render(owner, root, replace=True)
    if not related:
        hide_relationship_lines()
    return root


def hide_relationship_lines() -> None:
    """Hide the lines from objects to their parents in all 3D viewports, since every camera has one."""
    for screen in bpy.data.screens:
        for area in screen.areas:
            for space in area.spaces:
                if space.type == "VIEW_3D":
                    space.overlay.show_relationship_lines = False
