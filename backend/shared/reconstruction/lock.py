"""Exclusive lock on a reconstruction folder: an operating system lock on DIR/.lock.

The system releases the lock when the process ends in any way, so locks are never stale. The file contains the process
ID, which is used only in messages.
"""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..errors import InputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]
    import msvcrt

NAME = ".lock"
_PATIENCE = 0.5
"""Time in seconds to retry for, since `lock_holder` briefly acquires the lock to test whether it is free."""
_HELD = (errno.EACCES, errno.EAGAIN, errno.EDEADLK)
"""Errors if another process holds a lock; others are those of file systems without locks, as some networks have, where
nothing is excluded."""
_LOCKED_BYTE = 1 << 30
"""Offset of the byte that is locked on Windows; it is beyond the content, which therefore stays readable."""


class FolderInUse(InputError):
    """The folder is locked by another process."""

    fields = {"in_use": True}


@contextmanager
def locked(folder: Path, name: str = NAME, patience: float = _PATIENCE) -> Iterator[None]:
    """Hold the lock on `folder`, which must exist.

    Args:
        folder: The folder.
        name: File name of the lock; locks of different names are independent.
        patience: Seconds to wait for another holder.

    Raises:
        FolderInUse: Another process, or another part of this process, holds the lock.
        OSError: The lock file cannot be written; `filename` is its path.
    """
    path = folder / name
    until = time.monotonic() + patience
    while (descriptor := _acquire(path)) is None:
        if time.monotonic() > until:
            holder = _process_id(path)
            who = f"another process (pid {holder})" if holder else "another process"
            raise FolderInUse(f"{folder} is in use by {who}; wait for it to finish or stop it.")
        time.sleep(0.02)
    try:
        try:
            os.ftruncate(descriptor, 0)
            os.write(descriptor, f"{os.getpid()}\n".encode())
        except OSError as error:
            error.filename = str(path)
            raise
        yield
    finally:
        _release(path, descriptor)


def lock_holder(folder: Path) -> int | None:
    """Return the ID of the process that holds the lock on `folder`: 0 if unknown, None if the folder is not locked."""
    path = folder / NAME
    try:
        descriptor = os.open(path, os.O_RDWR)
    except OSError:
        return None
    try:
        if _try_lock(descriptor):
            return None
    finally:
        os.close(descriptor)
    return _process_id(path) or 0


def _acquire(path: Path) -> int | None:
    """Return a descriptor of the locked file, or None if the lock is held elsewhere."""
    # As the process's umask allows, since a file that a killed process leaves may be met by another user of a group.
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    # The previous holder deletes the file, and a lock on a deleted file excludes no other process.
    if _try_lock(descriptor) and _is_same_file(path, descriptor):
        return descriptor
    os.close(descriptor)
    return None


def _release(path: Path, descriptor: int) -> None:
    """Delete the lock file and release the lock.

    Windows cannot delete an open file, so there the lock is released first; a file that another process has opened in
    between is not deleted.
    """
    if fcntl is not None:
        path.unlink(missing_ok=True)
    os.close(descriptor)
    if fcntl is None:
        with suppress(OSError):
            path.unlink(missing_ok=True)


def _try_lock(descriptor: int) -> bool:
    try:
        if fcntl is not None:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:
            os.lseek(descriptor, _LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
            os.lseek(descriptor, 0, os.SEEK_SET)
    except OSError as error:
        return error.errno not in _HELD
    return True


def _is_same_file(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _process_id(path: Path) -> int | None:
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None
