# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs that operators submit, and the folders of new reconstructions."""

import os
from collections.abc import Callable
from pathlib import Path

import bpy

from ...backend.shared.reconstruction.folder import Reconstruction
from ...objectgs_addon import scene
from ...objectgs_addon.blender import messages
from ...objectgs_addon.environment import locations
from ...objectgs_addon.running import background
from ...objectgs_addon.state import object_edits, object_list
from ...objectgs_addon.state.folder_state import folder_state
from . import need

STARTS_JOB = {"UNDO"}
"""`bl_options` of operators that start a job on a reconstruction.

The start is an undo step, or the first undo during the job would remove what came before it, such as the import. With
REGISTER, Adjust Last Operation would start the job again.
"""


LOST_EDITS = "Deleted and separated single splats come back, since the training of borders changes all splats"
"""What to say before a job if `loses_splat_edits`."""


def loses_splat_edits(context: bpy.types.Context) -> bool:
    """Return whether a training of the objects' borders makes edits of the active reconstruction's splats useless."""
    root = need.active_root(context)
    edits = scene.shown_edits(root)
    return edits is not None and edits.match and folder_state(scene.folder_of(root)).steps > 0


def submit_for_capture(
    operator: bpy.types.Operator, context: bpy.types.Context, title: str, command: str, *arguments: str
) -> set[str]:
    """Submit a command of the backend on the capture of the active reconstruction.

    Args:
        operator: The operator, which reports to the user.
        context: Its context.
        title: Title of the job, to which the name of the reconstruction is added.
        command: The command, which is also the kind of the job; its first options are the capture and --out.
        arguments: Further options.

    Returns:
        The result of the operator.
    """
    root = need.active_root(context)
    folder = scene.folder_of(root)
    capture = str(folder_state(folder).capture)
    job = locations.backend_job(
        f"{title} {root.name}", command, folder, command, capture, "--out", str(folder), *arguments
    )
    return background.submit(job, context.scene, operator.report)


def store_edits(root: bpy.types.Collection) -> None:
    """Write pending edits to objects.json before a job uses it, and tell if the scene does not show what it has.

    Another scene, .blend or program may have written other edits there.

    Raises:
        InputError: objects.json cannot be used.
        OSError: objects.json cannot be written.
    """
    object_edits.store_edits(root)
    if not object_list.shows_edits(root):
        messages.show(object_list.newer_edits(root), operator="objectgs.show_result", label="Reload Result")


def folder_to_import_to(chosen: str, default: Callable[[], Path], capture: Path | None = None) -> Path:
    """Return the folder that an import writes to: the one that the user has chosen, or else `default()`.

    Args:
        chosen: The folder that the user has chosen, or empty.
        default: Called if it is empty.
        capture: The capture's folder, which may be in the chosen one.

    Raises:
        InputError: A job uses the folder, it contains files that are not of a reconstruction, or it is relative to a
            .blend that is not saved yet.
    """
    # Without links resolved, as collections of reconstructions store it.
    folder = Path(os.path.normpath(locations.absolute(chosen))) if chosen else default()
    need.require_unused(folder)
    Reconstruction(folder).require_own(capture)
    return folder
