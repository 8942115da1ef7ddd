# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras whose poses are less certain than those of others, drawn over Blender's own in colors from yellow to red."""

from __future__ import annotations

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from ..scene import is_in_file, uncertain_cameras

_YELLOW, _RED = np.array((1.0, 0.8, 0.1, 1.0)), np.array((1.0, 0.15, 0.05, 1.0))
_WIDTH = 2.5
"""Width of lines in pixels at a UI scale of 1."""
_EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (0, 4), (1, 4), (2, 4), (3, 4))
"""Of the corners of a camera's frame, in order, and its center."""

_handler = None


def _draw() -> None:
    context = bpy.context
    space = context.space_data
    if not (space.overlay.show_overlays and space.overlay.show_extras and is_in_file()):
        return
    lines, colors = [], []
    for camera, uncertainty in uncertain_cameras(context.view_layer, space):
        frame = np.array(camera.data.view_frame(scene=context.scene))
        frame *= camera.data.display_size / max(float(np.ptp(frame[:, 0])), 1e-9)
        corners = np.vstack([frame, np.zeros(3)])
        matrix = np.array(camera.matrix_world)
        lines.append((corners @ matrix[:3, :3].T + matrix[:3, 3])[np.array(_EDGES)].reshape(-1, 3))
        colors.append(np.tile(_YELLOW + uncertainty * (_RED - _YELLOW), (2 * len(_EDGES), 1)))
    if not lines:
        return
    shader = gpu.shader.from_builtin("POLYLINE_SMOOTH_COLOR")
    batch = batch_for_shader(
        shader, "LINES",
        {"pos": np.concatenate(lines).astype(np.float32), "color": np.concatenate(colors).astype(np.float32)},
    )  # fmt: skip
    gpu.state.blend_set("ALPHA")
    gpu.state.depth_test_set("LESS_EQUAL")
    shader.uniform_float("viewportSize", gpu.state.viewport_get()[2:])
    shader.uniform_float("lineWidth", _WIDTH * context.preferences.system.ui_scale)
    batch.draw(shader)
    gpu.state.depth_test_set("NONE")
    gpu.state.blend_set("NONE")


def register() -> None:
    global _handler
    if not bpy.app.background:
        _handler = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")


def unregister() -> None:
    global _handler
    if _handler is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handler, "WINDOW")
        _handler = None
