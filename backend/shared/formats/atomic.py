"""Atomic file writes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def atomic_path(path: Path, part: Path) -> Iterator[Path]:
    """Yield `part` for code that writes to a path; sync it and rename it to `path` at the end, or delete it on errors.

    `part` must be in the folder of `path`. The `filename` of an OSError is set to `path`, since some errors, such as a
    full disk, have none.
    """
    try:
        yield part
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        part.replace(path)
    except BaseException as error:
        part.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename = str(path)
        raise


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Open a binary file for writing that replaces `path` as in `atomic_path`."""
    with atomic_path(path, path.with_name(path.name + ".part")) as part, part.open("wb") as file:
        yield file


def write_atomic(path: Path, data: bytes) -> None:
    """Write `data` to `path` atomically."""
    with atomic_file(path) as file:
        file.write(data)
