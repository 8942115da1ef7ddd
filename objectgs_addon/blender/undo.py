# SPDX-License-Identifier: GPL-3.0-or-later
"""Undo steps of changes that no operator and no property of the interface makes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import bpy

from .older_files import KIND

_is_left_to_blender = False


def push(title: str) -> None:
    """Push an undo step; without a window, scripts push their own."""
    windows = bpy.context.window_manager.windows
    if windows and not bpy.app.background:
        with bpy.context.temp_override(window=windows[0]):
            bpy.ops.ed.undo_push(message=f"ObjectGS: {title}")


@contextmanager
def left_to_blender() -> Iterator[None]:
    """Push no steps for links meanwhile, in an edit of a property that Blender pushes a step for afterward.

    A step in between would hold the property's new value already, so that undoing the edit would not restore it.
    """
    global _is_left_to_blender
    before, _is_left_to_blender = _is_left_to_blender, True
    try:
        yield
    finally:
        _is_left_to_blender = before


@contextmanager
def step_for_links(title: str) -> Iterator[None]:
    """Push an undo step if the add-on's objects are moved, created, removed or linked meanwhile, or its collections.

    Undo keeps data-blocks that are equal in both of its steps as they are in memory. Without a step of its own, such a
    change would leave them with pointers to data-blocks that undo frees, and Blender would crash; or a transform would
    be undone without the change of its mesh.
    """
    if _is_left_to_blender:
        yield
        return
    before = _links()
    try:
        yield
    finally:
        if _links() != before:
            push(title)


def _links() -> list[Any]:
    """Return what the file's collections contain of the add-on, since the user may have moved it to any of them."""
    found = []
    for collection in (*bpy.data.collections, *(scene.collection for scene in bpy.data.scenes)):
        if collection.library is not None:
            continue
        children = [_uid(child) for child in collection.children if KIND in child]
        # The user's scenes may have tens of thousands of other objects.
        parts = [obj for obj in collection.objects if KIND in obj]
        if children or parts or KIND in collection:
            places = [(_uid(obj), _uid(obj.parent), _uid(obj.data), obj.matrix_basis.copy()) for obj in parts]
            found.append((_uid(collection), children, places))
    return found


def _uid(block: bpy.types.ID | None) -> int | None:
    return None if block is None else block.session_uid
