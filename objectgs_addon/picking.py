# SPDX-License-Identifier: GPL-3.0-or-later
"""Picking points of a reconstruction under the mouse: the nearest to the eye of those close to the cursor."""

import bpy
import gpu
import numpy as np
from bpy_extras.view3d_utils import location_3d_to_region_2d
from gpu_extras.batch import batch_for_shader

from . import scene

REACH = 12.0
"""Pixels around the cursor in which a point counts as clicked."""


class Picker:
    """World positions of everything visible in a reconstruction, and those picked so far."""

    def __init__(self, context, root) -> None:
        positions = [_world_positions(part) for collection in (root, *root.children_recursive)
                     for part in collection.objects
                     if scene.kind_of(part) in ("points", "splats", "mesh") and part.visible_get()]
        self.positions = np.concatenate(positions) if positions else np.zeros((0, 3))
        self.picked = []
        self._handler = None

    @property
    def has_points(self) -> bool:
        return len(self.positions) > 0

    def begin(self, context, text: str) -> None:
        """Show a cross-hair, the picked points and `text`, until `end`."""
        self._handler = bpy.types.SpaceView3D.draw_handler_add(self._draw, (), "WINDOW", "POST_PIXEL")
        context.window.cursor_modal_set("CROSSHAIR")
        self.say(context, text)

    def say(self, context, text: str) -> None:
        """Show `text` in the status bar."""
        context.workspace.status_text_set(text)
        context.area.tag_redraw()

    def end(self, context) -> None:
        """Take back what `begin` showed."""
        bpy.types.SpaceView3D.draw_handler_remove(self._handler, "WINDOW")
        context.window.cursor_modal_restore()
        self.say(context, None)

    def pick(self, context, event) -> bool:
        """Add the point under the mouse; False where there is none."""
        region = next(region for region in context.area.regions if region.type == "WINDOW")
        mouse = np.array([event.mouse_x - region.x, event.mouse_y - region.y], float)
        place = nearest(self.positions, np.array(context.space_data.region_3d.perspective_matrix),
                        (region.width, region.height), mouse, REACH)
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


def nearest(positions, perspective, size, mouse, reach: float) -> int | None:
    """Index of the point to pick, or None.

    positions (N, 3) world; perspective (4, 4) world to clip space; size (width, height) and mouse (2,) in pixels from
    the lower left. Of the points within `reach` pixels, those up to a tenth deeper than the foremost compete by their
    distance on the screen.
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


def _world_positions(part):
    """(N, 3) float64 vertices of an object's mesh in world coordinates."""
    local = np.empty(3 * len(part.data.vertices), np.float32)
    part.data.vertices.foreach_get("co", local)
    matrix = np.array(part.matrix_world)
    return local.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
