"""Files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def atomic_path(path: Path, part: Path) -> Iterator[Path]:
    """`part`, beside `path`, for what writes files by itself; synced and renamed at the end, so that `path` is old or
    new, never half.

    An OSError names `path`, also where the system names nothing (a full disk).
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
    """A file to write to, which becomes `path` as with `atomic_path`."""
    with atomic_path(path, path.with_name(path.name + ".part")) as part, part.open("wb") as file:
        yield file


def write_atomic(path: Path, data: bytes) -> None:
    """Write `data` to `path` as `atomic_file` does."""
    with atomic_file(path) as file:
        file.write(data)
