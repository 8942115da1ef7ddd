# SPDX-License-Identifier: GPL-3.0-or-later
"""Lines of strokes, which stay where they were drawn until the objects of the strokes are found."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from typing import Any

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from .. import drawing, scene
from ..picking.point_picker import shown_positions
from . import pointing

_WHITE = (1.0, 1.0, 1.0)
_OUTLINE = (0.0, 0.0, 0.0, 0.8)
_WIDTH, _OUTLINE_WIDTH = 2.0, 4.0
"""Widths in pixels at a UI scale of 1."""

_SAMPLES = 24
"""Largest number of places of a line whose depth is looked up."""
_REACH = 8.0
"""Distance in pixels of a line within which points of the scene tell its depth."""
_FRONT = 0.2
"""Share of these points that are in front of the line."""

_MOST_POINTS = 200_000
"""Largest number of points of the scene in which a line's depth is looked up."""
_AT_ONCE = 0.05
"""Time in seconds after which the lines that are still to be placed wait for the next redraw."""

_placed: dict[int, dict[str, np.ndarray]] = {}
"""Session UID of a reconstruction -> of each waiting stroke, its line in the capture, (n, 3)."""
_handler = None


def draw_line(points: Sequence[Sequence[float]], color: Sequence[float] = _WHITE) -> None:
    """Draw a line with a dark outline, which is seen on any background.

    Args:
        points: its corners (x, y) in pixels from the lower left or, in a 3D view, (x, y, z) in the world.
        color: red, green and blue.
    """
    shader = gpu.shader.from_builtin("POLYLINE_UNIFORM_COLOR")
    batch = batch_for_shader(shader, "LINE_STRIP", {"pos": [(*point, 0.0)[:3] for point in points]})
    scale = bpy.context.preferences.system.ui_scale
    gpu.state.blend_set("ALPHA")
    shader.uniform_float("viewportSize", gpu.state.viewport_get()[2:])
    for rgba, width in ((_OUTLINE, _OUTLINE_WIDTH), ((*color, 1.0), _WIDTH)):
        shader.uniform_float("color", rgba)
        shader.uniform_float("lineWidth", width * scale)
        batch.draw(shader)
    gpu.state.blend_set("NONE")


def on_surface(stroke: dict[str, Any], positions: np.ndarray) -> np.ndarray:
    """Return the line of a stroke on what its camera sees there.

    Args:
        stroke: with a camera, as `marks.add_stroke` makes it.
        positions: (N, 3) points of the scene in the capture.

    Returns:
        (n, 3) in the capture; none where the camera sees no points.

    Raises:
        KeyError, TypeError, ValueError, IndexError: the stroke has no camera or is not valid.
    """
    camera = stroke["camera"]
    viewmat, (fx, fy, cx, cy) = np.array(camera["viewmat"], float), camera["intrinsics"]
    pixels = np.array(stroke["points"], float) * (camera["width"], camera["height"])
    if stroke.get("area"):
        pixels = np.concatenate([pixels, pixels[:1]])
    if np.ptp(pixels, axis=0).max() < 1.0:
        # A click would have no length.
        pixels = pixels[0] + np.array([[-3.0, 0.0], [3.0, 0.0]])
    seen = positions @ viewmat[:3, :3].T + viewmat[:3, 3]
    seen = seen[seen[:, 2] > 0.0]
    at, depths = seen[:, :2] / seen[:, 2:] * (fx, fy) + (cx, cy), seen[:, 2]
    near = ((at >= pixels.min(0) - _REACH) & (at <= pixels.max(0) + _REACH)).all(1)
    at, near_depths = at[near], depths[near]
    known = {}
    for index in np.unique(np.linspace(0, len(pixels) - 1, _SAMPLES).astype(int)).tolist():
        there = near_depths[np.hypot(*(at - pixels[index]).T) <= _REACH]
        if len(there):
            known[index] = np.quantile(there, _FRONT)
    if not known and len(depths):
        known[0] = np.median(depths)
    if not known:
        return np.zeros((0, 3))
    z = np.interp(np.arange(len(pixels)), list(known), list(known.values()))[:, None]
    in_camera = np.hstack([(pixels - (cx, cy)) / (fx, fy) * z, z])
    return (in_camera - viewmat[:3, 3]) @ viewmat[:3, :3]


def lines(
    root: bpy.types.Collection, view_layer: bpy.types.ViewLayer, space: bpy.types.SpaceView3D | None
) -> list[tuple[np.ndarray, tuple[float, ...]]]:
    """Return the lines of a reconstruction's strokes that are not answered yet, which a viewport shows.

    Those of many strokes on a large scene follow in the next redraws.

    Returns:
        Of each line, its corners (n, 3) in the world, and its color.
    """
    waiting = [(stroke, json.dumps(stroke)) for stroke in pointing.waiting_strokes(root)]
    before = _placed.pop(root.session_uid, {})
    if not waiting:
        return []
    placed = _placed[root.session_uid] = {key: before[key] for _, key in waiting if key in before}
    to_world = scene.capture_to_world(root)
    missing = {key: stroke for stroke, key in waiting if key not in placed}
    if missing:
        until = time.monotonic() + _AT_ONCE
        to_capture = np.linalg.inv(to_world)
        positions = shown_positions(root, view_layer, space, _MOST_POINTS) @ to_capture[:3, :3].T + to_capture[:3, 3]
        for key, stroke in missing.items():
            try:
                placed[key] = on_surface(stroke, positions)
            except (KeyError, TypeError, ValueError, IndexError):  # Those on photos have no camera.
                placed[key] = np.zeros((0, 3))
            if time.monotonic() > until:
                break
        if not missing.keys() <= placed.keys() and not bpy.app.timers.is_registered(drawing.redraw):
            bpy.app.timers.register(drawing.redraw, first_interval=0.0)
    colors = {item.object_id: tuple(item.color) for item in root.objectgs.marked}
    return [
        (placed[key] @ to_world[:3, :3].T + to_world[:3, 3], colors.get(stroke["object"], _WHITE))
        for stroke, key in waiting
        if len(placed.get(key, ()))
    ]


def _draw() -> None:
    context = bpy.context
    root = context.scene.objectgs.active
    if root is None or not context.space_data.overlay.show_overlays:
        return
    for points, color in lines(root, context.view_layer, context.space_data):
        draw_line(points.tolist(), color)


def register() -> None:
    global _handler
    if not bpy.app.background:
        _handler = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")


def unregister() -> None:
    global _handler
    _placed.clear()
    if _handler is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handler, "WINDOW")
        _handler = None
