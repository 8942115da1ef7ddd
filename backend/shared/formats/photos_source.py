"""Photos and videos: suffixes of their files; what a capture was computed from, and how certain its poses are.

These are stored in its sfm/source.json and sfm/sfm.json.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import InputError
from .json_file import read_json, write_json
from .regular_file import is_file, is_folder

WORK = "sfm"
"""Folder in the capture for what the computation of poses keeps."""
REPORT = "sfm.json"
"""File there about the poses that were found."""
SOURCE = "source.json"
FORMER = "former"
"""Folder there with the model and `SOURCE` of the earlier run, until the present one has ended."""
SPARSE = Path("sparse", "0")
"""Folder in the capture for the poses and points."""

# Suffixes in lower case

IMAGES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".ppm", ".pgm"}
"""Images that a capture may contain."""
HEIC = {".heic", ".heif", ".hif", ".avif"}
"""Photos of phones."""
RAW = {".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"}
"""Unprocessed photos of cameras, which need the package rawpy."""
PHOTOS = IMAGES | HEIC | RAW
NOT_OF_USERS = (".", "@eaDir", "#recycle")
"""How names of files and folders begin that computers put beside photos, such as thumbnails."""
VIDEOS = {".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mts", ".m2ts", ".mpg", ".mpeg", ".wmv", ".3gp"}
LISTS = re.compile(r"(labels?|classes|names|test)[\w.-]*\.(json|txt|csv)", re.IGNORECASE)
"""Files with names of objects or of held-out photos, which may be beside the folders of photos and of masks."""


def natural_order(name: str) -> list[tuple[int, str]]:
    """Return a sort key by which photo 10 follows photo 9."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name.lower())]


@dataclass(frozen=True)
class PhotosSource:
    """The arguments of the command `sfm`.

    Attributes:
        photos: one folder, or files of photos and videos, as absolute paths.
        cameras: which photos share a camera.
        frames: wanted number of frames of each video, or None.
        leave_out: names of photos that are not used.
        features: where features are found, "auto" or "objects".
        set: which of the sets of photos that nothing connects is used, 1 for the largest.
        calibration: file or folder with the photos' cameras, or None where these are not known.
        matcher: folder with a checkpoint of LightGlue or EfficientLoFTR, as an absolute path; None for SIFT.
    """

    photos: list[Path]
    cameras: str = "auto"
    frames: int | None = None
    leave_out: list[str] = field(default_factory=list)
    features: str = "auto"
    set: int = 1
    calibration: Path | None = None
    matcher: Path | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the arguments as a dict for JSON."""
        return {
            "photos": [str(path.resolve()) for path in self.photos],
            "cameras": self.cameras,
            "frames": self.frames,
            "leave_out": self.leave_out,
            "features": self.features,
            "set": self.set,
            "calibration": None if self.calibration is None else str(self.calibration.resolve()),
            "matcher": None if self.matcher is None else str(self.matcher.resolve()),
        }

    @classmethod
    def of(cls, stored: Mapping[str, Any]) -> PhotosSource:
        """Return the arguments from the result of `as_dict`; raise KeyError, TypeError or ValueError if invalid."""
        frames, calibration, matcher = stored.get("frames"), stored.get("calibration"), stored.get("matcher")
        return cls(
            [Path(path) for path in stored["photos"]],
            str(stored.get("cameras", "auto")),
            None if frames is None else int(frames),
            [str(name) for name in stored.get("leave_out", [])],
            "objects" if stored.get("features") == "objects" else "auto",
            max(int(stored.get("set", 1)), 1),
            None if calibration is None else Path(calibration),
            None if matcher is None else Path(matcher),
        )


def write_source(capture: Path, source: PhotosSource) -> None:
    """Write sfm/source.json of a capture."""
    write_json(capture / WORK / SOURCE, source.as_dict())


def read_source(capture: Path) -> PhotosSource | None:
    """Read sfm/source.json of a capture; return None if it is missing or invalid."""
    try:
        return PhotosSource.of(read_json(capture / WORK / SOURCE))
    except (InputError, AttributeError, KeyError, TypeError, ValueError):
        return None


def has_poses(capture: Path) -> bool:
    """Return whether the poses of a capture were computed from photos alone."""
    return is_file(capture / WORK / REPORT) and is_folder(capture / SPARSE)


class PhotoError(NamedTuple):
    """Error of a photo's pose.

    Attributes:
        pixels: median reprojection error of its points.
        weak: why its pose is less certain than those of others, or "".
    """

    pixels: float
    weak: str


def read_photo_errors(capture: Path) -> dict[str, PhotoError]:
    """Return the errors of the photos by name; {} if the capture's poses are given, or sfm/sfm.json is invalid."""
    try:
        report = read_json(capture / WORK / REPORT)
        weak = report["weak"]
        found = {
            str(name): PhotoError(float(each["error"]), str(weak.get(name, "")))
            for name, each in report["figures"].items()
        }
    except (InputError, AttributeError, KeyError, TypeError, ValueError):
        return {}
    return {name: each for name, each in found.items() if math.isfinite(each.pixels)}


def read_up(capture: Path) -> list[float] | None:
    """Return what is up in a capture's world, (3,), if its photos told that to `sfm`; else None."""
    try:
        x, y, z = (float(value) for value in read_json(capture / WORK / REPORT)["up"])
    except (InputError, KeyError, TypeError, ValueError):
        return None
    return [x, y, z] if math.isfinite(x * x + y * y + z * z) and x * x + y * y + z * z > 0 else None
