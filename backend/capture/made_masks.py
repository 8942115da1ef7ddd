"""The masks/ of a capture, written as a whole."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..shared.errors import InputError
from ..shared.formats.atomic import PART_PREFIX, PART_SUFFIX, replace_file, require_still_there
from ..shared.formats.json_file import read_json
from ..shared.reconstruction.folder import STROKES
from .files import encode_mask

RECORD, REPAIRED = "masks.json", "repair.json"
"""Files in masks/ with how they were made of other masks, and with what was changed in them."""

OVERVIEW = "masks.jpg"
"""File in masks/ with a picture of some of them."""

SAME_IDS = "same_ids"
"""Key in repair.json: whether IDs mean the objects that they meant in the given masks."""

SEGMENTS = "masks-segments"
"""Folder of a capture with the segments that models have found, so that a stopped command goes on."""


def is_made(folder: Path) -> bool:
    """Return whether masks/ was made here, of other masks or of strokes, so that it can be replaced."""
    return is_made_of_others(folder) or is_repaired(folder) or (folder / STROKES).is_file()


def is_made_of_others(folder: Path) -> bool:
    """Return whether masks/ was made of other masks; a masks.json may also be of the program that made them."""
    return _content(folder / RECORD).keys() >= {"source", "objects"}


def is_repaired(folder: Path) -> bool:
    """Return whether masks in masks/ were corrected."""
    return "changed" in _content(folder / REPAIRED)


def has_ids_of(folder: Path, given: Path) -> bool:
    """Return whether IDs in masks/ mean what they mean in the given masks, of which it has copies or corrections."""
    made, source = ([_content(each / name) for name in (RECORD, STROKES, REPAIRED)] for each in (folder, given))
    return not is_made(folder) or made == source or (made[:2] == source[:2] and made[2].get(SAME_IDS) is True)


def _content(path: Path) -> dict[str, Any]:
    """Return the content of a JSON file, which is empty if it cannot be read or is none of this program."""
    try:
        content = read_json(path)
    except InputError:
        return {}
    return content if isinstance(content, dict) else {}


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
    require_still_there(folder)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
