# SPDX-License-Identifier: GPL-3.0-or-later
"""Folders that this user has created, opened or accepted in Blender, outside of any .blend.

Paths stored in a .blend are used only if they are among them, since the .blend may be someone else's. Paths are
compared as text, so that the comparison touches neither the folder nor its computer.
"""

from __future__ import annotations

import os
from pathlib import Path

from ...backend.shared.errors import InputError
from ...backend.shared.formats.json_file import read_json, write_json
from . import locations

NAME = "known_folders.json"
MOST = 1000
"""Number of folders that are remembered; the oldest are forgotten first."""
_LARGEST = 8 << 20
"""Size in bytes above which the file was not written by this module."""

_read: tuple[Path, tuple[int, int], list[str]] | None = None
"""Path, modification time (ns) and size of the file that was read last, and its folders."""
_unwritten: list[str] = []
"""Folders that are known until Blender is closed, because the file could not be written."""


def is_known(folder: Path) -> bool:
    """Return whether the user has created, opened or accepted this folder; polls and panels can call this."""
    key = _key(folder)
    return key is not None and (key in _unwritten or key in _folders())


def can_be_known(folder: Path) -> bool:
    """Return whether the path is absolute, as every folder must be that is used."""
    return _key(folder) is not None


def remember(folder: Path) -> bool:
    """Make a folder known; return whether this outlasts the running Blender.

    The file is read again first, since another Blender may have added folders.
    """
    key = _key(folder)
    if key is None:
        return False
    folders = [other for other in _folders() if other != key]
    try:
        _path().parent.mkdir(parents=True, exist_ok=True)
        write_json(_path(), {"folders": [*folders, key][-MOST:]})
    except (OSError, ValueError):  # ValueError: a path that is not valid Unicode
        if key not in _unwritten:
            _unwritten.append(key)
        return False
    return True


def is_remote(folder: Path) -> bool:
    r"""Return whether a path names another computer, as in \\host\share, where reading would send a login to it."""
    return len(str(folder)) > 1 and all(character in "\\/" for character in str(folder)[:2])


def _path() -> Path:
    return locations.user_folder() / NAME


def _key(folder: Path) -> str | None:
    """Return the text that a folder is compared by; None for a path that is not absolute."""
    text = str(folder)
    if "\0" in text or not (folder.is_absolute() or is_remote(folder)):
        return None
    return os.path.normcase(os.path.normpath(text))


def _folders() -> list[str]:
    """Return the remembered folders, the latest last; none if the file is missing or damaged."""
    global _read
    path = _path()
    try:
        state = path.stat()
    except OSError:
        return []
    stamp = state.st_mtime_ns, state.st_size
    if _read is None or _read[:2] != (path, stamp):
        _read = path, stamp, _valid(path) if state.st_size <= _LARGEST else []
    return _read[2]


def _valid(path: Path) -> list[str]:
    try:
        folders = read_json(path)["folders"]
        return [entry for entry in folders if isinstance(entry, str)][-MOST:]
    except (InputError, KeyError, TypeError, RecursionError):
        return []
