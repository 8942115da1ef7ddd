# SPDX-License-Identifier: GPL-3.0-or-later
"""Show the contents of a reconstruction folder in the scene."""

from pathlib import Path
from typing import Any

import bpy

from ...backend.shared.errors import InputError
from ...backend.shared.reconstruction.folder import Reconstruction
from ...objectgs_addon import scene
from ...objectgs_addon.blender import messages
from ...objectgs_addon.environment import known_folders
from ...objectgs_addon.picking import marks
from ...objectgs_addon.running import background
from ...objectgs_addon.state import object_edits
from ...objectgs_addon.state import viewports as view


def show_folder(operator: bpy.types.Operator, context: bpy.types.Context, folder: Path, root: Any) -> None:
    """Show what a folder contains, and report it through `operator`.

    root: the collection to show it in, or None to add one. The folder counts as accepted once its cameras are shown.

    Raises InputError for unusable cameras; what is wrong with splats and meshes is reported.
    """
    is_new = root is None
    root = view.show_first(context.scene, folder) if is_new else scene.show_capture(context.scene, folder, root)
    known_folders.remember(folder)
    object_edits.fill(root)
    context.scene.objectgs.active = root
    if is_new:
        marks.restore(root, folder)
        view.show(root)
    try:
        if Reconstruction(folder).splats.exists():
            if not scene.object_collections(root):
                view.hide_capture(root)
            shown = scene.show_result(root, folder)
            for sentence in shown.warnings:
                operator.report({"WARNING"}, sentence)
            operator.report({"INFO"}, f"{shown.splats:,} splats of {shown.objects} objects")
            object_edits.fill(root)
            background.fill_holes(root)
    except (InputError, OSError) as error:
        operator.report({"ERROR"}, messages.sentence(error))  # Cameras and points are shown; they need an undo step.
