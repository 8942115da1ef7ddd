"""Files and folders: whether they exist, and opening for reading. Pipes and devices are refused; they may block."""

from __future__ import annotations

import errno
import os
import stat
from io import BufferedReader
from pathlib import Path


def require_regular(path: Path) -> Path:
    """Return `path`; raise OSError with a `strerror` if it is missing, a folder, a pipe or a device."""
    mode = path.stat().st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "it is a pipe or a device", str(path))
    return path


def open_regular(path: Path) -> BufferedReader:
    """Open a file for reading; raise OSError as `require_regular`."""
    return require_regular(path).open("rb")


def read_regular(path: Path, largest: int | None = None) -> bytes:
    """Read a file; raise OSError as `require_regular`, and ValueError if it has more than `largest` bytes."""
    with open_regular(path) as file:
        if largest is not None and os.fstat(file.fileno()).st_size > largest:
            raise ValueError(f"it is larger than {largest >> 20} MB")
        return file.read()


def is_file(path: Path) -> bool:
    """Return whether a file exists; False, too, where access is denied."""
    return os.path.isfile(path)  # noqa: PTH113 - Path.is_file raises then


def is_folder(path: Path) -> bool:
    """Return whether a folder exists; False, too, where access is denied."""
    return os.path.isdir(path)  # noqa: PTH112 - Path.is_dir raises then


def resolved(folder: str | Path) -> str:
    """Return a text that is the same for all paths to a folder, by symbolic links or names of drives."""
    return os.path.normcase(os.path.realpath(folder))
