# SPDX-License-Identifier: GPL-3.0-or-later
"""The question whether to use the output folder of film frames that a .blend from elsewhere names."""

from typing import Any

import bpy

from ...objectgs_addon import scene
from ...objectgs_addon.environment import known_folders
from ...objectgs_addon.film.properties import folder_of, is_accepted
from ..common import need


class UsesOutputFolder:
    """Mixin of operators that use the output folder: they ask once for each folder that the user did not choose.

    Scripts, which call `execute` without `invoke`, are not asked.
    """

    execute: Any

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        folder = scene.folder_of(need.active_root(context))
        if is_accepted(context.scene, folder):
            return self.execute(context)
        return context.window_manager.invoke_confirm(
            self,
            event,
            title="Use This Output Folder?",
            message=f"The file names it: {folder_of(context.scene, folder)}",
            confirm_text="Use This Folder",
            icon="QUESTION",
        )

    def remember_output(self, context: bpy.types.Context) -> None:
        """Do not ask about the output folder again."""
        folder = scene.folder_of(need.active_root(context))
        if not is_accepted(context.scene, folder):
            known_folders.remember(folder_of(context.scene, folder))
