# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether the reconstruction folder named in a .blend may be used.

A .blend may be someone else's, or its folder may have been moved. Until the user has accepted the folder, nothing is
read, written, deleted or started there; edits stay in the .blend, and are written once the folder is accepted.
Acceptance belongs to the user and not to the .blend, so that undo does not change it (`environment/known_folders.py`).
"""

from __future__ import annotations

import os
from pathlib import Path

import bpy

from ...backend.shared.errors import InputError
from ...backend.shared.reconstruction.folder import Reconstruction
from .. import scene
from ..environment import known_folders
from ..scene.kinds import FOLDER, RELATIVE_FOLDER
from .folder_state import UNKNOWN, FolderState, folder_state

REFUSAL = "This file comes from elsewhere or was moved; press Use This Folder in the ObjectGS tab first"
"""Why the folder is not used, without a final period. The panel names the folder; tooltips cut off long texts."""

MOST_LEVELS_UP = 2
"""Number of folders above the .blend's that a relative path may reach; it should not lead to anything but a project."""


def is_accepted(root: bpy.types.Collection) -> bool:
    """Return whether the reconstruction's folder may be used; draws and polls can call this."""
    return known_folders.is_known(scene.folder_of(root))


def require_accepted(root: bpy.types.Collection) -> None:
    """Raise InputError unless the reconstruction's folder may be used."""
    if not is_accepted(root):
        raise InputError(f"{REFUSAL}.")


def state_of(root: bpy.types.Collection) -> FolderState:
    """Return the state of the reconstruction's folder, which is read only if it is accepted."""
    return folder_state(scene.folder_of(root)) if is_accepted(root) else UNKNOWN


def offered(root: bpy.types.Collection) -> Path:
    """Return the folder that the user is asked about: one at the same place relative to the .blend, else the stored."""
    return moved_folder(root) or scene.folder_of(root)


def moved_folder(root: bpy.types.Collection) -> Path | None:
    """Return the reconstruction folder that was moved or copied together with the .blend, or None.

    Only the surroundings of the .blend are searched, which Blender has just read. Where its relative path leads to the
    stored folder, neither was moved, and what is found elsewhere is another reconstruction.
    """
    if not bpy.data.filepath or root.library is not None:
        return None
    relative, stored = root.get(RELATIVE_FOLDER), root.get(FOLDER)
    paths = [relative, stored[2:] if isinstance(stored, str) and stored.startswith("//") else None, "."]
    for path in paths:
        folder = _beside_blend(path) if isinstance(path, str) else None
        if folder is not None and folder == scene.folder_of(root):
            return None
        if folder is not None and Reconstruction(folder).cameras.is_file():
            return folder
    return None


def _beside_blend(relative: str) -> Path | None:
    """Return the folder at a path relative to the .blend, with `/` between names; None if it leads elsewhere."""
    names = relative.split("/")
    up = next((index for index, name in enumerate(names) if name != ".."), len(names))
    invalid = any(name in ("", "..") or set(name) & {"\\", ":", "\0"} for name in names[up:])
    if invalid or up > MOST_LEVELS_UP:
        return None
    return Path(os.path.normpath(Path(bpy.data.filepath).parent.joinpath(*names)))


def is_in_question(root: bpy.types.Collection) -> bool:
    """Return whether the user must be asked about the folder: it is not accepted, or is missing and was moved."""
    if not is_accepted(root):
        return True
    return not state_of(root).exists and moved_folder(root) is not None


def store_relative(root: bpy.types.Collection, blend: str) -> None:
    """Store the folder relative to the .blend, so that it is found when both are moved.

    blend: path of the file that is being saved.
    """
    try:
        relative = Path(os.path.relpath(scene.folder_of(root), Path(blend).parent)).as_posix()
    except ValueError:  # another drive
        relative = ""
    if root.get(RELATIVE_FOLDER) != relative:
        root[RELATIVE_FOLDER] = relative
