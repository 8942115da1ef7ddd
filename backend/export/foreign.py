"""Splats of other programs, in any of the formats that are read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..model.splats import Splats
from .ply import read_splats
from .splat import read_splat
from .spz import read_spz

_READERS: dict[str, Callable[[Path], tuple[Splats, list[str]]]] = {".spz": read_spz, ".splat": read_splat}


def read_foreign_splats(path: Path) -> tuple[Splats, list[str]]:
    """Read splats as SPZ or .splat, chosen by the file's suffix, or else as PLY.

    Args:
        path: The file to read.

    Returns:
        The splats, and warnings about those that were dropped.

    Raises:
        InputError: The file is missing, damaged or not in the format of its suffix.
    """
    return _READERS.get(path.suffix.lower(), read_splats)(path)
