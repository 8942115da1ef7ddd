# SPDX-License-Identifier: GPL-3.0-or-later
"""Undo steps of changes that no operator and no property of the interface makes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import bpy


def push(title: str) -> None:
    """Push an undo step; without a window, scripts push their own."""
    windows = bpy.context.window_manager.windows
    if windows and not bpy.app.background:
        with bpy.context.temp_override(window=windows[0]):
            bpy.ops.ed.undo_push(message=f"ObjectGS: {title}")


@contextmanager
def step_for_links(title: str) -> Iterator[None]:
    """Push an undo step if objects are moved meanwhile, or collections and objects created, removed or linked.

    Undo keeps data-blocks that are equal in both of its steps as they are in memory. Without a step of its own, such a
    change would leave them with pointers to data-blocks that undo frees, and Blender would crash; or a transform would
    be undone without the change of its mesh.
    """
    before = _links()
    try:
        yield
    finally:
        if _links() != before:
            push(title)


def _links() -> list[Any]:
    """Return what all collections of the file contain, since the user may have moved those of a reconstruction."""
    return [
        (
            _uid(collection),
            [_uid(child) for child in collection.children],
            [(_uid(obj), _uid(obj.parent), _uid(obj.data), obj.matrix_basis.copy()) for obj in collection.objects],
        )
        for collection in (*bpy.data.collections, *(scene.collection for scene in bpy.data.scenes))
        if collection.library is None
    ]


def _uid(block: bpy.types.ID | None) -> int | None:
    return None if block is None else block.session_uid
