"""The folder of photos that a capture was computed from, in sfm/source.json of the capture."""

from __future__ import annotations

from pathlib import Path

from ..errors import InputError
from .json_file import read_json, write_json

WORK = "sfm"
"""Folder in the capture for what the computation of poses keeps."""
_SOURCE = "source.json"


def remember_photos(capture: Path, photos: Path) -> None:
    """Store which folder of photos a capture is computed from."""
    write_json(capture / WORK / _SOURCE, {"photos": str(photos.resolve())})


def photos_of(capture: Path) -> Path | None:
    """Return the folder of photos that a capture is computed from; None if it is not known."""
    try:
        stored = read_json(capture / WORK / _SOURCE)
    except InputError:
        return None
    photos = stored.get("photos") if isinstance(stored, dict) else None
    return Path(photos) if isinstance(photos, str) else None
