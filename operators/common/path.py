# SPDX-License-Identifier: GPL-3.0-or-later
"""What operators share that follow the mouse in a 3D viewport until its button is released."""

from __future__ import annotations

import math
from typing import Any

import bpy
from bpy.props import CollectionProperty

from ...objectgs_addon.running.stroke_lines import draw_line
from .viewport import InViewport

_SPACING = 2.0
"""Smallest distance in pixels of the positions of a path."""

Points = list[tuple[float, float]]


class FollowsMouse(InViewport):
    """Base of operators whose `execute` uses the path of the mouse, in pixels from the lower left of the region."""

    path: CollectionProperty(type=bpy.types.OperatorMousePath, options={"HIDDEN", "SKIP_SAVE"})

    _handler: Any
    _region: bpy.types.Region
    execute: Any

    def keeps_path(self, context: bpy.types.Context) -> bool:
        """Return whether all of the path is needed, and not only its ends."""
        raise NotImplementedError

    def outline(self, points: Points) -> Points:
        """Return the line to draw for a path."""
        raise NotImplementedError

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.path.clear()
        self._append(context, event)
        self._append(context, event)
        self._region = context.region
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

    def pixels(self, height: int) -> Points:
        """Return the centers of the path's pixels in a region of this height, from the upper left."""
        return [(item.loc[0] + 0.5, height - item.loc[1] - 0.5) for item in self.path]

    def _append(self, context: bpy.types.Context, event: bpy.types.Event) -> None:
        item = self.path.add()
        item.loc = event.mouse_x - context.region.x, event.mouse_y - context.region.y

    def _move(self, context: bpy.types.Context, event: bpy.types.Event) -> None:
        """Move the end of the path to the mouse, and keep where it was if all of the path is needed."""
        end, before = self.path[-1], self.path[-2]
        if self.keeps_path(context) and math.dist(end.loc, before.loc) >= _SPACING:
            self._append(context, event)
        else:
            end.loc = event.mouse_x - context.region.x, event.mouse_y - context.region.y

    def _end(self, context: bpy.types.Context) -> None:
        bpy.types.SpaceView3D.draw_handler_remove(self._handler, "WINDOW")
        context.area.tag_redraw()

    def _draw(self) -> None:
        if bpy.context.region == self._region:
            draw_line(self.outline([tuple(item.loc) for item in self.path]))


def rectangle(points: Points) -> Points:
    """Return the outline of the rectangle between the first and the last of the points."""
    (left, bottom), (right, top) = points[0], points[-1]
    return [(left, bottom), (right, bottom), (right, top), (left, top), (left, bottom)]
