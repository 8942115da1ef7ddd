# SPDX-License-Identifier: GPL-3.0-or-later
"""The file dialog of the imports, which the backend runs."""

from typing import Any

import bpy

from . import need


class ImportDialog:
    """Mixin of operators that choose a file or folder and start a job of the backend."""

    @classmethod
    def poll(cls: Any, _context: bpy.types.Context) -> bool:
        return need.backend(cls)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}
