# SPDX-License-Identifier: GPL-3.0-or-later
"""View and shading of the 3D viewports, and what changes when a reconstruction is shown for the first time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
import numpy as np

from .. import drawing, scene
from ..picking import selection
from . import object_list, visibility


def show(root: bpy.types.Collection) -> None:
    """Show the scene as its first camera sees it in all 3D viewports, and color attributes in Solid mode."""
    widen_clipping(root)
    for window in bpy.context.window_manager.windows:
        if root not in window.scene.collection.children_recursive:
            continue
        window.view_layer.update()
        cameras = sorted(
            (part for part in root.all_objects if scene.kind_of(part) == "camera" and part.data is not None),
            key=lambda camera: camera.name,
        )
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.spaces.active.shading.color_type = "VERTEX"
                if cameras and area.spaces.active.region_3d is not None:
                    _look_as(area.spaces.active, cameras)


def hide_capture(root: bpy.types.Collection, is_hidden: bool = True) -> None:
    """Hide the capture when splats or meshes replace it: its points also in instances, its cameras in view layers.

    is_hidden: False shows it again.
    """
    points = [part for part in root.all_objects if scene.kind_of(part) == "points"]
    for part in points:  # Hiding frees the list of the collection's objects.
        part.hide_viewport = is_hidden
    for owner in object_list.scenes_of(root):
        for view_layer in owner.view_layers:
            if (layer := visibility.capture_layer(view_layer, root)) is not None:
                layer.hide_viewport = is_hidden


def show_kinds(root: bpy.types.Collection, which: str) -> None:
    """Show splats, meshes or both, as `scene.show_kinds` does; selected objects stay outlined."""
    scene.show_kinds(root, which)
    keep_outlines(root)


def keep_outlines(root: bpy.types.Collection) -> None:
    """Select what has become visible of objects of which a part is selected."""
    for owner in object_list.scenes_of(root):
        for view_layer in owner.view_layers:
            selection.select_shown_parts(view_layer, root)


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


def subject_of(centers: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return the point that cameras look at: the nearest one to their optical axes in the least-squares sense.

    Args:
        centers: (n, 3) positions.
        axes: (n, 3) unit vectors along which they look.

    Returns:
        (3,), which may lie behind cameras that look apart.
    """
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    # Parallel axes leave the distance along them open; a weak pull to the cameras closes it.
    pull = 1e-3 * np.eye(3)
    return np.linalg.solve((across + pull).sum(0), ((across + pull) @ centers[:, :, None]).sum(0))[:, 0]


def _look_as(space: bpy.types.SpaceView3D, cameras: list[bpy.types.Object]) -> None:
    """Look from just before the first camera, whose drawing would fill the view, and turn around what all look at.

    From outside, the walls of a captured room would hide it.
    """
    poses = np.array([camera.matrix_world for camera in cameras])
    centers, axes = poses[:, :3, 3], -poses[:, :3, 2]
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    far = float((subject_of(centers, axes) - centers[0]) @ axes[0])
    spread = float(np.linalg.norm(np.ptp(centers, axis=0)))
    if not 0.1 * spread < far < 2.0 * spread:  # Cameras that look outward, or in parallel.
        far = spread or 1.0
    drawn = cameras[0].data
    before = min(1.5 * drawn.display_size * drawn.lens / drawn.sensor_width, 0.5 * far)
    region = space.region_3d
    region.view_perspective = "PERSP"
    region.view_rotation = cameras[0].matrix_world.to_quaternion()
    region.view_location = centers[0] + far * axes[0]
    region.view_distance = far - before


def show_first(owner: bpy.types.Scene, folder: Path) -> bpy.types.Collection:
    """Show the cameras and points of a folder in a scene that does not show them yet, and return the collection.

    Blender's startup scene is set up for renders through the capture's first camera, its cube, camera and light are
    disabled, since they would stand in the captured room, and Solid mode shows colors without shading. Any other scene
    is the user's.

    Raises:
        InputError: The folder's files cannot be used; nothing is changed.
    """
    untouched, related = scene.is_untouched(owner), any(obj.parent is not None for obj in owner.objects)
    startup = list(owner.objects) if untouched else []
    root = scene.show_capture(owner, folder)
    if untouched:
        scene.set_up_render(owner, root, replace=True)
        for obj in startup:
            # Show Hidden Objects (Alt+H) shows what is only hidden, and the cube would cover the scene.
            obj.hide_viewport = obj.hide_render = True
        for space in _spaces():
            space.shading.color_type, space.shading.light = "VERTEX", "FLAT"
    if not related:
        hide_relationship_lines()
    return root


def widen_clipping(root: bpy.types.Collection) -> None:
    """Let all 3D viewports show a reconstruction of any size."""
    scene.widen_clipping(root, _spaces())


def hide_relationship_lines() -> None:
    """Hide the lines from objects to their parents in all 3D viewports, since every camera has one."""
    for space in _spaces():
        space.overlay.show_relationship_lines = False


def _spaces() -> list[bpy.types.SpaceView3D]:
    """Return all 3D viewports of all workspaces."""
    return [
        space
        for screen in bpy.data.screens
        for area in screen.areas
        for space in area.spaces
        if space.type == "VIEW_3D"
    ]
