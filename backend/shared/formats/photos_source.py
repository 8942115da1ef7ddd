"""What a capture was computed from, and how, in sfm/source.json of the capture."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ..errors import InputError
from .json_file import read_json, write_json

WORK = "sfm"
"""Folder in the capture for what the computation of poses keeps."""
_SOURCE = "source.json"


@dataclass(frozen=True)
class PhotosSource:
    """The arguments of the command `sfm`.

    Attributes:
        photos: one folder, or files of photos and videos, as absolute paths.
        cameras: which photos share a camera.
        frames: wanted number of frames of each video, or None.
        leave_out: names of photos that are not used.
    """

    photos: list[Path]
    cameras: str = "auto"
    frames: int | None = None
    leave_out: list[str] = field(default_factory=list)


def write_source(capture: Path, source: PhotosSource) -> None:
    """Write sfm/source.json of a capture."""
    write_json(
        capture / WORK / _SOURCE,
        {
            "photos": [str(path.resolve()) for path in source.photos],
            "cameras": source.cameras,
            "frames": source.frames,
            "leave_out": source.leave_out,
        },
    )


def read_source(capture: Path) -> PhotosSource | None:
    """Read sfm/source.json of a capture; return None if it is missing or invalid."""
    try:
        stored = read_json(capture / WORK / _SOURCE)
        frames = stored.get("frames")
        return PhotosSource(
            [Path(path) for path in stored["photos"]],
            str(stored.get("cameras", "auto")),
            None if frames is None else int(frames),
            [str(name) for name in stored.get("leave_out", [])],
        )
    except (InputError, AttributeError, KeyError, TypeError, ValueError):
        return None
