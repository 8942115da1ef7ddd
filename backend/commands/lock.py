"""One process at a time makes splats in a reconstruction folder: DIR/.lock holds its process ID."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

from ..protocol import InputError

LOCK = ".lock"

_WRITTEN_WITHIN = 1.0
"""Seconds in which a lock that was just made gets its content."""
_CLOCKS_DIFFER = 5.0
"""Seconds by which a process's start and a file's time may be wrong against each other."""


class FolderInUse(InputError):
    """Another process trains in the folder."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep the folder for this process; FolderInUse where another one has it.

    A lock whose process is gone (killed, or the machine went off) is taken over.
    """
    path = folder / LOCK
    while not _made(path):
        holder = _holder(path)
        if holder is not None:
            raise FolderInUse(f"{folder} is being trained by another process (pid {holder}); wait for it or stop it.")
        path.unlink(missing_ok=True)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


def _made(path: Path) -> bool:
    """Make the lock; False where there is one."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
    except FileExistsError:
        return False
    try:
        with open(descriptor, "w") as file:
            file.write(f"{os.getpid()}\n")
    except BaseException as error:
        path.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename = str(path)
        raise
    return True


def _holder(path: Path) -> int | None:
    """The process that holds the lock, or None where it is gone."""
    try:
        made = path.stat().st_mtime
        while not (text := path.read_text().strip()) and abs(time.time() - made) < _WRITTEN_WITHIN:
            time.sleep(0.02)
        process = psutil.Process(int(text))
        if process.status() == psutil.STATUS_ZOMBIE:
            return None
        # Process IDs come again, above all after a restart of the machine or of a container.
        return process.pid if process.create_time() < made + _CLOCKS_DIFFER else None
    except psutil.AccessDenied:
        return int(text)
    except (FileNotFoundError, ValueError, psutil.NoSuchProcess):
        return None
