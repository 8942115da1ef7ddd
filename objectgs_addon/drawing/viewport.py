# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats in the 3D viewports: drawn over Blender's own picture, hidden by what is in front of them."""

import bpy
import gpu
import numpy as np

from ...backend.picking import View
from .. import writing
from ..scene import kind_of
from ..scene.drawn import show_preview
from . import gather
from .renderer import Renderer

_renderer: Renderer | None = None
_trouble: str | None = None
_handler = None
_pointed_at: int | None = None
"""The number of this session of the object's collection that a tool highlights."""


def renderer() -> Renderer:
    """The one renderer of this Blender, made when it is first needed."""
    global _renderer
    if _renderer is None:
        _renderer = Renderer()
    return _renderer


def trouble() -> str | None:
    """Why splats cannot be drawn on this computer, or None."""
    return _trouble


def picture(context_scene, view_layer, view: View, projection: np.ndarray) -> np.ndarray:
    """(height, width, 4) float32 premultiplied: what a scene's splats look like, without anything else.

    Needs a Blender with a window.
    """
    parts = gather.splat_parts(view_layer)
    things = gather.gather(parts, context_scene.objectgs.splat_colours, marks=False)
    if not renderer().draw(things, view, projection, None):
        return np.zeros((view.height, view.width, 4), np.float32)
    return renderer().pixels()


def _draw() -> None:
    global _trouble
    context = bpy.context
    space, region = context.space_data, context.region_data
    properties = context.scene.objectgs
    if not properties.draw_splats or region is None or _trouble is not None:
        return
    try:
        renderer()
    except Exception as error:  # Drivers differ in what they refuse, and Blender raises no type of its own.
        _trouble = f"The graphics driver refuses to draw splats: {error}"
        print(f"ObjectGS: {_trouble}", flush=True)
        return
    parts = gather.splat_parts(context.view_layer, space)
    things = gather.gather(parts, properties.splat_colours, _pointed_at, space.overlay.show_overlays)
    if not things:
        return
    target = gpu.state.active_framebuffer_get()
    x, y, width, height = target.viewport_get()
    projection = np.array(region.window_matrix)
    view = View.of_matrices(np.array(region.view_matrix), projection, width, height)
    depth = None
    if gather.hides_splats(context.view_layer, space):
        read = target.read_depth(x, y, width, height)
        read.dimensions = width * height
        depth = np.array(read, np.float32).reshape(height, width)
    if renderer().draw(things, view, projection, depth):
        renderer().over()


def point_at(collection) -> None:
    """Highlight an object, by its collection, in all viewports; None: no object."""
    global _pointed_at
    uid = None if collection is None else collection.session_uid
    if uid != _pointed_at:
        _pointed_at = uid
        redraw()


def show(properties, _context=None) -> None:
    """Let the preview of the geometry nodes give way to the drawing in a scene, or come back."""
    for part in properties.id_data.objects:
        if kind_of(part) == "splats":
            show_preview(part, not properties.draw_splats)
    redraw()


def redraw(_properties=None, _context=None) -> None:
    """Let all 3D viewports draw anew."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


@bpy.app.handlers.persistent
@writing.allowed
def _changed(scene, _depsgraph) -> None:
    """New splats come with their preview."""
    if scene.objectgs.draw_splats:
        for part in scene.objects:
            if kind_of(part) == "splats":
                show_preview(part, False)


def register():
    global _handler
    if not bpy.app.background:
        _handler = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")
        bpy.app.handlers.depsgraph_update_post.append(_changed)


def unregister():
    global _handler, _renderer
    if _handler is not None:
        bpy.app.handlers.depsgraph_update_post.remove(_changed)
        bpy.types.SpaceView3D.draw_handler_remove(_handler, "WINDOW")
        _handler = None
        for scene in bpy.data.scenes:
            for part in scene.objects:
                if kind_of(part) == "splats":
                    show_preview(part, True)
    if _renderer is not None:
        _renderer.free()
        _renderer = None
