# SPDX-License-Identifier: GPL-3.0-or-later
"""What operators that select in a 3D viewport share: their condition and their mode."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.props import EnumProperty

from . import need


class InViewport:
    """Base of operators that need a 3D viewport in Object Mode."""

    poll_message_set: Any

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if context.region_data is None:
            cls.poll_message_set("This needs a 3D viewport")
            return False
        return need.object_mode(cls, context)


def selection_mode() -> Any:
    """Return the property of whether a selection is set, extended or reduced."""
    return EnumProperty(
        name="Mode",
        options={"SKIP_SAVE"},
        items=[
            ("SET", "Set", "Set a new selection"),
            ("ADD", "Add", "Extend the existing selection"),
            ("SUBTRACT", "Subtract", "Subtract from the existing selection"),
        ],
    )
