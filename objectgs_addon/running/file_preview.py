# SPDX-License-Identifier: GPL-3.0-or-later
"""The preview image that Blender stores in a .blend, taken from the window while splats are shaded.

By default, Blender renders this image with the shading of the viewport each time a file is saved. For splats in
Material Preview, this takes longer than everything else in saving; without a fast graphics card, up to a minute.
"""

from __future__ import annotations

from typing import Any

import bpy

from .. import scene

_replaced = False
"""Whether the preference is changed until the file is saved."""


@bpy.app.handlers.persistent
def _saving(*_: Any) -> None:
    """Let Blender take a screenshot if it would choose to render splats; a choice of the user is kept."""
    global _replaced
    preferences = bpy.context.preferences
    if preferences.filepaths.file_preview_type == "AUTO" and not bpy.app.background and _splats_are_shaded():
        _set("SCREENSHOT")
        _replaced = True


@bpy.app.handlers.persistent
def _saved(*_: Any) -> None:
    global _replaced
    if _replaced:
        _replaced = False
        _set("AUTO")


def _set(kind: str) -> None:
    """Set the preference without marking the preferences as changed."""
    preferences = bpy.context.preferences
    is_dirty = preferences.is_dirty
    preferences.filepaths.file_preview_type = kind
    preferences.is_dirty = is_dirty


def _splats_are_shaded() -> bool:
    """Return whether a viewport with materials or rendered shading is open, and the file has splats."""
    spaces = [
        area.spaces.active
        for window in bpy.context.window_manager.windows
        for area in window.screen.areas
        if area.type == "VIEW_3D"
    ]
    if all(space.shading.type not in ("MATERIAL", "RENDERED") for space in spaces):
        return False
    return any(scene.kind_of(obj) == "splats" for obj in bpy.data.objects)


_HANDLERS = (("save_pre", _saving), ("save_post", _saved), ("save_post_fail", _saved))


def register() -> None:
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).append(handler)


def unregister() -> None:
    for name, handler in _HANDLERS:
        getattr(bpy.app.handlers, name).remove(handler)
    _saved()
