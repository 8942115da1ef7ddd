"""The masks/ of a capture, written as a whole."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ..shared.errors import InputError
from ..shared.formats.atomic import PART_PREFIX, PART_SUFFIX, replace_file
from ..shared.formats.json_file import read_json
from ..shared.reconstruction.folder import STROKES
from .files import encode_mask

RECORD, REPAIRED = "masks.json", "repair.json"
"""Files in masks/ with how they were made of other masks, and with what was changed in them."""

SEGMENTS = "masks-segments"
"""Folder of a capture with the segments that models have found, so that a stopped command goes on."""


def is_made(folder: Path) -> bool:
    """Return whether masks/ was made here, of other masks or of strokes, so that it can be replaced."""
    return is_made_of_others(folder) or is_repaired(folder) or (folder / STROKES).is_file()


def is_made_of_others(folder: Path) -> bool:
    """Return whether masks/ was made of other masks; a masks.json may also be of the program that made them."""
    return _has(folder / RECORD, "source", "objects")


def is_repaired(folder: Path) -> bool:
    """Return whether masks in masks/ were corrected."""
    return _has(folder / REPAIRED, "changed")


def _has(path: Path, *keys: str) -> bool:
    """Return whether a JSON file has these keys."""
    try:
        content = read_json(path)
    except InputError:
        return False
    return isinstance(content, dict) and content.keys() >= set(keys)


def kept_masks(capture: Path) -> Path:
    """Return the folder in which the given masks of a capture are kept when others, made of them, replace them."""
    return capture / "masks-given"


def require_place_for_given(capture: Path) -> None:
    """Raise InputError if the given masks of a capture cannot be kept, since others are kept already."""
    if kept_masks(capture).exists():
        raise InputError(f"{kept_masks(capture)} exists, where the given masks would be kept; move it elsewhere.")


@contextmanager
def new_masks(capture: Path, kept: Path | None = None) -> Iterator[Path]:
    """Yield an empty folder that becomes the masks/ of a capture when the body is done; on errors, nothing changes.

    Args:
        capture: the capture's folder.
        kept: where masks/ is moved to that was there before; None: it is deleted.
    """
    folder = capture / "masks"
    part, old = (capture / f"{PART_PREFIX}{name}{PART_SUFFIX}" for name in ("masks", "masks-old"))
    if old.exists() and not folder.exists():
        replace_file(old, folder)  # An earlier run was killed in between.
    for left in (part, old):
        shutil.rmtree(left, ignore_errors=True)
    part.mkdir()
    try:
        yield part
        if folder.exists():
            replace_file(folder, kept or old)
        try:
            replace_file(part, folder)
        except OSError:
            if (kept or old).exists():
                replace_file(kept or old, folder)
            raise
    finally:
        shutil.rmtree(part, ignore_errors=True)
        # What could not be put back is there for the next run.
        if folder.exists():
            shutil.rmtree(old, ignore_errors=True)


def write_mask(folder: Path, name: str, mask: np.ndarray) -> None:
    """Write the mask (h, w) of the photo `name` to a folder of masks."""
    suffix, data = encode_mask(mask)
    path = folder / (name + suffix)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
