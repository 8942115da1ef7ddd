"""Folder of compiled kernels. numba's files there are pickles, which can run any code when they are loaded."""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import sys
import tempfile
from pathlib import Path

_VARIABLE = "NUMBA_CACHE_DIR"


def use_private_cache() -> str | None:
    """Point numba to a cache that only this user can write; call this before numba is imported.

    The cache is the folder in NUMBA_CACHE_DIR, else one in the user's cache folder. A folder that is not private is not
    used; if neither is, kernels are kept for this process alone.

    Returns:
        A sentence for the user about the first folder that is not used, or None.
    """
    sentence = None
    for folder in _candidates():
        why = _why_not(folder)
        if why is None:
            os.environ[_VARIABLE] = str(folder.absolute())
            return sentence
        sentence = sentence or (
            f"{folder} {why}, so it is not used for compiled kernels, which run as code; delete it, or name another "
            f"folder in {_VARIABLE}."
        )
    temporary = tempfile.mkdtemp(prefix="objectgs-kernels-")
    atexit.register(shutil.rmtree, temporary, ignore_errors=True)
    os.environ[_VARIABLE] = temporary
    return sentence


def _candidates() -> list[Path]:
    chosen = os.environ.get(_VARIABLE)
    folders = [Path(chosen)] if chosen else []
    # Some services and containers run for users without a home.
    with contextlib.suppress(RuntimeError):
        folders.append(_user_cache())
    return folders


def _user_cache() -> Path:
    """Return the folder for caches of this program, by the convention of the system."""
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "objectgs"
    # A variable that is set has an absolute path, which replaces what is before it.
    if sys.platform == "win32":
        return Path.home() / "AppData" / "Local" / os.environ.get("LOCALAPPDATA", "") / "ObjectGS" / "kernels"
    return Path.home() / ".cache" / os.environ.get("XDG_CACHE_HOME", "") / "objectgs"


def _why_not(folder: Path) -> str | None:
    """Create `folder` for this user alone if it is missing; return why it is not used, or None if it is."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        # On Windows, the user's folders are private by their access lists.
        if sys.platform != "win32":
            found = folder.stat()
            if found.st_uid != os.geteuid():
                return "belongs to another user"
            if found.st_mode & 0o022:
                return "can be written by other users"
        # numba fails where it cannot write, as on a disk that is mounted read-only.
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        return f"cannot be used ({error.strerror})"
    return None
