# SPDX-License-Identifier: GPL-3.0-or-later
"""Mouse picking of points of a reconstruction."""

from __future__ import annotations

from typing import Any

import bpy
import gpu
import numpy as np
from bpy_extras.view3d_utils import location_3d_to_region_2d
from gpu_extras.batch import batch_for_shader

from .. import drawing, scene
from ..drawing.splat_arrays import arrays_of

REACH = 12.0
"""Distance from the cursor, in pixels, within which a point can be picked."""

MIN_OPACITY = 0.3
"""Fainter splats cannot be picked, since they are hardly seen and often far from any surface."""


class PointPicker:
    """Picker with the world positions of the points of a reconstruction, and the points picked so far.

    They are the vertices and splats that a view layer shows in one of its viewports.
    """

    def __init__(
        self, root: bpy.types.Collection, view_layer: bpy.types.ViewLayer, space: bpy.types.SpaceView3D | None
    ) -> None:
        self.positions = shown_positions(root, view_layer, space)
        self.picked = []
        self._handler = None

    @property
    def has_points(self) -> bool:
        return len(self.positions) > 0

    def begin(self, context: bpy.types.Context, text: str) -> None:
        """Show a crosshair, the picked points and `text` in the status bar, until `end`."""
        self._handler = bpy.types.SpaceView3D.draw_handler_add(self._draw, (), "WINDOW", "POST_PIXEL")
        context.window.cursor_modal_set("CROSSHAIR")
        self.show_status(context, text)

    def show_status(self, context: bpy.types.Context, text: str) -> None:
        """Show `text` in the status bar."""
        context.workspace.status_text_set(text)
        context.area.tag_redraw()

    def end(self, context: bpy.types.Context) -> None:
        """Restore the cursor and the status bar, where these are still there."""
        if self._handler is not None:
            bpy.types.SpaceView3D.draw_handler_remove(self._handler, "WINDOW")
            self._handler = None
        if context.window is not None:
            context.window.cursor_modal_restore()
        if context.workspace is not None and context.area is not None:
            self.show_status(context, None)

    def pick(self, context: bpy.types.Context, event: bpy.types.Event) -> bool:
        """Add the point under the mouse; return False if there is none."""
        # Quad View has four of them.
        region = next(
            (
                region
                for region in context.area.regions
                if region.type == "WINDOW"
                and 0 <= event.mouse_x - region.x < region.width
                and 0 <= event.mouse_y - region.y < region.height
            ),
            None,
        )
        if region is None:
            return False
        mouse = np.array([event.mouse_x - region.x, event.mouse_y - region.y], float)
        perspective = np.array(region.data.perspective_matrix)
        place = nearest(self.positions, perspective, (region.width, region.height), mouse, REACH)
        if place is None:
            return False
        self.picked.append(tuple(float(value) for value in self.positions[place]))
        return True

    def _draw(self) -> None:
        context = bpy.context
        places = [location_3d_to_region_2d(context.region, context.region_data, point) for point in self.picked]
        shader = gpu.shader.from_builtin("UNIFORM_COLOR")
        shader.uniform_float("color", (1.0, 0.6, 0.0, 1.0))
        for place in places:
            if place is not None:
                x, y = place
                diamond = [(x - 6, y, 0), (x, y + 6, 0), (x + 6, y, 0), (x, y - 6, 0), (x - 6, y, 0)]
                batch_for_shader(shader, "LINE_STRIP", {"pos": diamond}).draw(shader)


def nearest(positions: Any, perspective: Any, size: Any, mouse: Any, reach: float) -> int | None:
    """Return the point to pick.

    Candidates are within `reach` pixels of the mouse and at most a tenth deeper than the frontmost of these points. The
    candidate nearest to the mouse on the screen is picked.

    Args:
        positions: (N, 3) in world coordinates.
        perspective: (4, 4) world to clip space.
        size: (width, height) of the region in pixels.
        mouse: (2,) pixels from the lower left.
        reach: largest distance from the mouse in pixels.

    Returns:
        Index of the point, or None.
    """
    clip = positions @ perspective[:3, :3].T + perspective[:3, 3]
    w = positions @ perspective[3, :3] + perspective[3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        screen = (clip[:, :2] / w[:, None] * 0.5 + 0.5) * np.asarray(size, float)
        depth = clip[:, 2] / w
        distance = np.hypot(*(screen - mouse).T)
    close = np.flatnonzero((distance <= reach) & (w > 0) & (np.abs(depth) <= 1.0))
    if len(close) == 0:
        return None
    deep = w[close]
    front = close[deep <= deep.min() + 0.1 * abs(deep.min())]
    return int(front[np.argmin(distance[front])])


def shown_positions(
    root: bpy.types.Collection,
    view_layer: bpy.types.ViewLayer,
    space: bpy.types.SpaceView3D | None,
    at_most: int | None = None,
) -> np.ndarray:
    """Return the vertices and splats that a view layer shows in one of its viewports, (N, 3) float64 in the world.

    at_most: the largest number of them; of more, every k-th is returned.
    """
    parts = [
        part
        for collection in (root, *root.children_recursive)
        for part in collection.objects
        if scene.kind_of(part) in ("points", "splats", "mesh") and drawing.shown(part, view_layer, space)
    ]
    count = sum(len(part.data.vertices) for part in parts)
    step = 1 if at_most is None else max(-(-count // at_most), 1)
    return np.concatenate([np.zeros((0, 3)), *(_world_positions(part, step) for part in parts)])


def _world_positions(part: bpy.types.Object, step: int) -> np.ndarray:
    """Return every `step`-th vertex or visible splat of an object in world coordinates, (N, 3) float64."""
    arrays = arrays_of(part.data) if scene.kind_of(part) == "splats" else None
    if arrays is not None:
        local = arrays.means[::step][arrays.opacities[::step] > MIN_OPACITY]
    else:
        local = np.empty((len(part.data.vertices), 3), np.float32)
        part.data.vertices.foreach_get("co", local.reshape(-1))
        local = local[::step]
    matrix = np.array(part.matrix_world)
    return local @ matrix[:3, :3].T + matrix[:3, 3]
