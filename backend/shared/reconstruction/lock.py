"""One process at a time writes to a reconstruction folder: it holds a lock of the operating system on DIR/.lock.

The system gives the lock back when the process ends, however it ends, so that no lock is ever stale. The file holds the
process ID, for messages alone.
"""

from __future__ import annotations

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

_NAME = ".lock"
_PATIENCE = 0.5
"""Seconds to try for, since `lock_holder` holds the lock for a moment to see whether it is free."""
_LOCKED_BYTE = 1 << 30
"""On Windows a byte is locked, beyond the content, which can then be read."""


class FolderInUse(InputError):
    """Another process writes to the folder."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep `folder`, which must exist, for this process.

    Raises:
        FolderInUse: another process, or another part of this one, has it.
        OSError: the lock cannot be written; its file name is the lock's.
    """
    path = folder / _NAME
    patience = time.monotonic() + _PATIENCE
    while (descriptor := _acquire(path)) is None:
        if time.monotonic() > patience:
            holder = _process_id(path)
            who = f"another process (pid {holder})" if holder else "another process"
            raise FolderInUse(f"{folder} is being trained by {who}; wait for it or stop it.")
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
    """The ID of the process that writes to `folder`; 0 where it is unknown, None where there is no such process."""
    path = folder / _NAME
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
    """A descriptor of the locked file; None where another one holds it."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    # The holder before removes the file: a lock on a removed file keeps nobody out.
    if _try_lock(descriptor) and _is_same_file(path, descriptor):
        return descriptor
    os.close(descriptor)
    return None


def _release(path: Path, descriptor: int) -> None:
    """Remove the lock's file and let go of it. Windows refuses to remove an open file, and then removes no other's."""
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
    except OSError:
        return False
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
