# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats drawn over the 3D viewports, occluded by geometry in front of them."""

from __future__ import annotations

from typing import Any

import bpy
import gpu
import numpy as np

from ...backend.shared.color import srgb
from ...backend.shared.splats.picking import View
from ..blender import writing
from ..scene import is_in_file
from ..scene.shading.modifiers import show_preview
from . import detail, gather
from .renderer import Renderer, TooManySplats

_WAIT = 0.3
"""Seconds between looks at whether the levels of detail are built."""

OUTLINE = 1.5
"""Width of outlines in pixels at a UI scale of 1."""

_renderer: Renderer | None = None
_failure: str | None = None
_refusal: str | None = None
"""Why the splats of the viewport drawn last are not shown."""
_handler = None
_pointed_at: int | None = None
"""Session UID of the collection that a tool outlines."""


def renderer() -> Renderer:
    """Return the shared renderer, created on first use."""
    global _renderer
    if _renderer is None:
        _renderer = Renderer()
    return _renderer


def failure() -> str | None:
    """Return why splats cannot be drawn, or None."""
    return _failure or _refusal


def picture(context_scene: Any, view_layer: bpy.types.ViewLayer, view: View, projection: np.ndarray) -> np.ndarray:
    """Render only the splats of a scene; requires Blender with a window.

    Args:
        context_scene: scene whose setting selects the colors.
        view_layer: view layer whose visible splats are drawn.
        view: camera and image size.
        projection: (4, 4) OpenGL projection matrix of the view.

    Returns:
        (height, width, 4) float32, premultiplied, sRGB-encoded.
    """
    parts = gather.placed_parts(view_layer)
    objs = gather.gather(parts, context_scene.objectgs.colors, marks=False)
    if not renderer().draw(objs, view, projection, None):
        return np.zeros((view.height, view.width, 4), np.float32)
    return renderer().pixels()


def _draw() -> None:
    context = bpy.context
    if context.region_data is None or _failure is not None or not is_in_file():
        return
    if not context.scene.objectgs.draw_splats:
        _free_unused()
        return
    try:
        renderer()
    except Exception as error:  # Driver failures raise various exceptions.
        _fail(f"The graphics driver cannot draw splats: {error}")
        return
    try:
        _draw_splats(context)
    except (MemoryError, RuntimeError) as error:
        renderer().free()
        _fail(f"Splats cannot be drawn, maybe for lack of memory ({error}); hide some and switch Draw Splats on again")


def _fail(reason: str) -> None:
    """Draw no splats but show their previews, instead of failing again in each redraw."""
    global _failure
    _failure = reason
    print(f"ObjectGS: {_failure}", flush=True)
    bpy.app.timers.register(_show_previews, first_interval=0.0)  # Data cannot be changed while drawing.


def _draw_splats(context: bpy.types.Context) -> None:
    """Draw the splats of the context's viewport over it."""
    global _refusal
    space, region = context.space_data, context.region_data
    properties = context.scene.objectgs
    _refusal = None
    parts = gather.placed_parts(context.view_layer, space)
    objs = gather.gather(parts, properties.colors, _pointed_at, space.overlay.show_overlays)
    meshes = gather.meshes_of(_pointed_at, context.view_layer, space)
    if not objs:
        _free_unused()
        if not meshes:
            return
    target = gpu.state.active_framebuffer_get()
    x, y, width, height = target.viewport_get()
    projection = np.array(region.window_matrix)
    view = View.of_matrices(np.array(region.view_matrix), projection, width, height)
    depth = None
    if objs and gather.may_hide_splats(context.view_layer, space):
        read = target.read_depth(x, y, width, height)
        read.dimensions = width * height
        depth = np.array(read, np.float32).reshape(height, width)
    objs = detail.with_levels(objs)
    if detail.is_building() and not bpy.app.timers.is_registered(_redraw_when_built):
        bpy.app.timers.register(_redraw_when_built, first_interval=_WAIT)
    try:
        is_drawn = renderer().draw(objs, view, projection, depth)
    except TooManySplats as error:
        _refusal = str(error)
        return
    if meshes:
        depsgraph = context.evaluated_depsgraph_get()
        shapes = [part.evaluated_get(depsgraph) for part in meshes]
        renderer().mark(shapes, view, np.array(region.perspective_matrix), clear=not is_drawn)
    if is_drawn or meshes:
        theme, scale = context.preferences.themes[0].view_3d, context.preferences.system.ui_scale
        renderer().composite(tuple(srgb.decode(theme.object_active[:3]).tolist()), OUTLINE * scale)


def _free_unused() -> None:
    """Free GPU memory where no scene has splats to draw any more; another viewport may draw those of its scene."""
    if _renderer is not None and _renderer.has_splats:
        drawn = (scene for scene in bpy.data.scenes if scene.objectgs.draw_splats)
        if not any(gather.carriers(scene) for scene in drawn):
            _renderer.free()


def point_at(collection: bpy.types.Collection) -> None:
    """Outline the object of a collection in all viewports; None removes the outline."""
    global _pointed_at
    uid = None if collection is None else collection.session_uid
    if uid != _pointed_at:
        _pointed_at = uid
        redraw()


def _is_drawn(properties: Any) -> bool:
    return properties.draw_splats and _failure is None


@writing.allowed
def _show_previews() -> None:
    for scene in bpy.data.scenes:
        show(scene.objectgs)


def switch(properties: Any, _context: bpy.types.Context) -> None:
    """Draw a scene's splats or show their previews, as its setting says, and try again what has failed before."""
    global _failure
    if _failure is None:
        show(properties)
    else:
        _failure = None
        _show_previews()  # Of all scenes, whose previews are shown since.


def show(properties: Any) -> None:
    """Switch a scene's splats between the geometry nodes preview and this drawing."""
    undrawn = _undrawn()
    for part in gather.carriers(properties.id_data):
        show_preview(part, part in undrawn)
    redraw()


def _undrawn() -> set[bpy.types.Object]:
    """Return the splats in scenes that do not draw them.

    Scenes that share splats share their preview, which then is also seen where they are drawn.
    """
    scenes = [scene for scene in bpy.data.scenes if not _is_drawn(scene.objectgs)]
    return {part for scene in scenes for part in gather.carriers(scene)}


def redraw(_properties: Any = None, _context: bpy.types.Context = None) -> None:
    """Redraw all 3D viewports."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


def _redraw_when_built() -> float | None:
    if detail.is_building():
        return _WAIT
    redraw()
    return None


@bpy.app.handlers.persistent
@writing.allowed
def _changed(scene: bpy.types.Scene, _depsgraph: Any) -> None:
    """Switch off the preview of new splats, or show it if drawing them has failed."""
    if scene.objectgs.draw_splats and is_in_file():
        undrawn = _undrawn()
        for part in gather.carriers(scene):
            show_preview(part, part in undrawn)


@bpy.app.handlers.persistent
@writing.allowed
def _file_loaded(*_: Any) -> None:
    """Try again what another file had no memory for; a driver that cannot draw splats has made no renderer."""
    global _failure
    if _renderer is not None:
        _failure = None
    if _failure is not None and is_in_file():
        _show_previews()


def register() -> None:
    global _handler
    if not bpy.app.background:
        _handler = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")
        bpy.app.handlers.depsgraph_update_post.append(_changed)
        bpy.app.handlers.load_post.append(_file_loaded)


def unregister() -> None:
    global _handler, _renderer
    if _handler is not None:
        bpy.app.handlers.load_post.remove(_file_loaded)
        bpy.app.handlers.depsgraph_update_post.remove(_changed)
        bpy.types.SpaceView3D.draw_handler_remove(_handler, "WINDOW")
        _handler = None
        for scene in bpy.data.scenes:
            for part in gather.carriers(scene):
                show_preview(part, True)
    detail.unregister()
    if _renderer is not None:
        _renderer.free()
        _renderer = None
