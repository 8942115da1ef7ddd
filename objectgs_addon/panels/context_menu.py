# SPDX-License-Identifier: GPL-3.0-or-later
"""Entries of the context menu of objects in the 3D viewport, for the objects of a reconstruction."""

from __future__ import annotations

from typing import Any

import bpy

from .. import scene


def draw(menu: Any, context: bpy.types.Context) -> None:
    """Draw the edits of the reconstruction's object that the active Blender object belongs to."""
    part = context.active_object
    object_id = scene.object_id_of(part) if part is not None else None
    if not object_id or scene.root_of(part, context.scene) is None:
        return
    layout = menu.layout
    layout.label(text="ObjectGS")
    for text, floaters, fill in (("Remove", False, False), ("Remove and Fill", False, True)):
        operator = layout.operator("objectgs.remove_object", text=text)
        operator.floaters, operator.fill = floaters, fill
    layout.operator("objectgs.clean_floaters").everything = False
    layout.operator("objectgs.duplicate_object")
    layout.operator("objectgs.solo_object")
    layout.operator("objectgs.extract_meshes")
    layout.separator()
