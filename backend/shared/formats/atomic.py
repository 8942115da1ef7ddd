"""Atomic file writes, and a record of the files and folders that they create."""

from __future__ import annotations

import errno
import os
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from ..errors import InputError

PART_PREFIX, PART_SUFFIX = ".objectgs-", ".part"
"""Beginning and end of the names of temporary files."""

_LONGEST = 100
"""Number of bytes of the file's name in that of its temporary file; file systems allow 255 in all."""

_ABANDONED_SECONDS = 24 * 3600

_PATIENCE = 2.0 if os.name == "nt" else 0.0
"""Seconds to wait for other processes that have a file open."""

_records: list[Created] = []


class Created:
    """Files and folders that `atomic_path` and `make_folder` have created; replaced ones are not among them."""

    def __init__(self) -> None:
        self._files: list[Path] = []
        self._folders: list[Path] = []

    def add_file(self, path: Path) -> None:
        """Record a new file."""
        self._files.append(path)

    def add_folder(self, path: Path) -> None:
        """Record a new folder."""
        self._folders.append(path)

    def remove_files(self) -> None:
        """Delete the files that still exist."""
        for path in self._files:
            with suppress(OSError):
                path.unlink()

    def remove_folders(self) -> None:
        """Delete the folders that are empty, innermost first."""
        for path in reversed(self._folders):
            with suppress(OSError):
                path.rmdir()


@contextmanager
def recorded() -> Iterator[Created]:
    """Record what this process creates in the body of the statement."""
    created = Created()
    _records.append(created)
    try:
        yield created
    finally:
        _records.remove(created)


def make_folder(path: Path) -> None:
    """Create a folder and its missing parents; do nothing if it exists.

    Raises:
        OSError: The folder cannot be created; `filename` is the path at fault.
    """
    missing = []
    for folder in (path, *path.parents):
        if folder.exists():
            break
        missing.append(folder)
    for folder in reversed(missing):
        try:
            folder.mkdir()
        except FileExistsError:
            if not folder.is_dir():
                raise
            continue  # Another process was faster.
        for record in _records:
            record.add_folder(folder)


def require_still_there(folder: Path) -> None:
    """Raise InputError if a folder that existed when the command began is gone, as of a disk that was unplugged.

    It is asked before folders are made in it, which would otherwise take its place where the disk was.
    """
    if not folder.is_dir():
        raise InputError(
            f"The folder {folder} is gone; connect its disk or put it back, and run the same command again to continue "
            "from what was saved there."
        ) from FileNotFoundError(errno.ENOENT, f"{folder} is gone", str(folder))


def remove_abandoned(folder: Path) -> None:
    """Delete temporary files below `folder` that killed processes have left there, as their age shows."""
    latest = time.time() - _ABANDONED_SECONDS
    for path in folder.rglob(f"{PART_PREFIX}*{PART_SUFFIX}"):
        with suppress(OSError):
            if path.lstat().st_mtime < latest:
                path.unlink()


def replace_file(part: Path, path: Path) -> None:
    """Rename a file or folder; a file at `path` is replaced.

    On Windows, this waits for a moment while another process reads what is renamed or replaced, such as Blender or a
    virus scanner.
    """
    until = time.monotonic() + _PATIENCE
    while True:
        try:
            part.replace(path)
            return
        except PermissionError:
            if time.monotonic() >= until:
                raise
            time.sleep(_PATIENCE / 40)


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield the path of an empty temporary file in the folder of `path`, which replaces `path` at the end.

    The file is synced first, or deleted on errors. Its name is random and the file is new, so neither another process
    nor a link can redirect the write. The `filename` of an OSError is set to `path`.
    """
    target = path.name.encode(errors="replace")[-_LONGEST:].decode(errors="ignore")
    part = path.with_name(f"{PART_PREFIX}{secrets.token_hex(8)}-{target}{PART_SUFFIX}")
    try:
        os.close(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0), 0o666))
        yield part
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        is_new = not os.path.lexists(path)
        replace_file(part, path)
    except BaseException as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename, error.filename2 = str(path), None
        raise
    if is_new:
        for record in _records:
            record.add_file(path)


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Open a binary file for writing that replaces `path` as in `atomic_path`."""
    with atomic_path(path) as part, part.open("wb") as file:
        yield file


def write_atomic(path: Path, data: bytes) -> None:
    """Write `data` to `path` atomically."""
    with atomic_file(path) as file:
        file.write(data)
