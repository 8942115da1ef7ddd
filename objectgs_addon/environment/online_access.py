# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's permission to use the network, which Set Up Backend needs for its downloads."""

from __future__ import annotations

import bpy


def can_be_allowed() -> bool:
    """Return whether online access is off and the preferences can allow it, which --offline-mode prevents."""
    return not bpy.app.online_access and not bpy.app.online_access_override


def allow() -> None:
    """Allow online access in Blender's preferences."""
    bpy.context.preferences.system.use_online_access = True


def remedy() -> str:
    """Return what the user can do to set the backend up, as a clause."""
    if bpy.app.online_access:
        return "press Set Up Backend"
    if can_be_allowed():
        return "allow online access, then press Set Up Backend"
    return "start Blender without --offline-mode, then press Set Up Backend"
