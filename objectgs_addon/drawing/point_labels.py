# SPDX-License-Identifier: GPL-3.0-or-later
"""Points of captures in the colors of marked objects, drawn over Blender's own."""

from __future__ import annotations

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from ..scene import is_in_file, shown_points
from .splat_arrays import Labels, point_labels

_SIZE = 6.0
"""Width of points in pixels at a UI scale of 1."""

_batches: dict[int, tuple[Labels, gpu.types.GPUBatch]] = {}
"""Session UID of a mesh -> what was drawn of it last."""
_handler = None


def _shader() -> gpu.types.GPUShader:
    try:
        return gpu.shader.from_builtin("POINT_FLAT_COLOR")
    except (ValueError, TypeError):  # Before Blender 4.5.
        return gpu.shader.from_builtin("FLAT_COLOR")


def _draw() -> None:
    context = bpy.context
    if not is_in_file():
        return
    for part in shown_points(context.view_layer, context.space_data):
        labels = point_labels(part.data)
        if labels is None:
            _batches.pop(part.data.session_uid, None)
            continue
        shader = _shader()
        known = _batches.get(part.data.session_uid)
        if known is None or known[0] is not labels:
            known = _batches[part.data.session_uid] = labels, _batch(part.data, labels, shader)
        gpu.state.point_size_set(_SIZE * context.preferences.system.ui_scale)
        with gpu.matrix.push_pop():
            gpu.matrix.multiply_matrix(part.matrix_world)
            known[1].draw(shader)


def _batch(mesh: bpy.types.Mesh, labels: Labels, shader: gpu.types.GPUShader) -> gpu.types.GPUBatch:
    positions = np.empty((len(mesh.vertices), 3), np.float32)
    mesh.vertices.foreach_get("co", positions.ravel())
    marked = labels.of_splats > 0
    colors = np.ones((int(marked.sum()), 4), np.float32)
    colors[:, :3] = labels.colors[labels.of_splats[marked] - 1]
    return batch_for_shader(shader, "POINTS", {"pos": positions[marked], "color": colors})


def register() -> None:
    global _handler
    if not bpy.app.background:
        _handler = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")


def unregister() -> None:
    global _handler
    _batches.clear()
    if _handler is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handler, "WINDOW")
        _handler = None
