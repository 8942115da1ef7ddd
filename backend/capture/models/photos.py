"""The photos of a capture, looked up by the names and paths with which other programs refer to them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from ...shared.errors import InputError
from ...shared.formats.photos_source import IMAGES, WORK
from ...shared.reconstruction.folder import Reconstruction
from ..files import Files, image_size
from ..made_masks import SEGMENTS, kept_masks

_NO_PHOTOS = ("masks", kept_masks(Path()).name, SEGMENTS, WORK)
"""Folders of a capture with images that are no photos."""


def photos_folder(folder: Path) -> Path:
    """Return the folder of a capture's photos: images/ or, where there is none, the capture itself."""
    return folder / "images" if (folder / "images").is_dir() else folder


def photo_files(capture: Path, folder: Path) -> Files:
    """Return the files in the folder of a capture's photos; if it is the capture's own, without what is made there."""
    if folder != capture:
        return Files(folder)
    settings = Reconstruction(capture).settings.name
    return Files(folder, without=(*_NO_PHOTOS, *(path.parent.name for path in capture.glob(f"*/{settings}"))))


def none_found(folder: Path, names: Sequence[str], file: Path) -> InputError:
    """Return the error for a model of which no photo exists.

    Args:
        folder: The folder of the photos.
        names: The photos that the model names.
        file: The file of the model that names them.
    """
    return InputError(
        f"{folder} contains none of the {len(names)} images that {file} names, for instance {names[0]}; put them there."
    )


def require_single(named: dict[str, str], photo: str, reference: str, file: Path) -> None:
    """Note what a file calls a photo; raise InputError if it was in another folder before, as in a rig.

    Args:
        named: What the file has called each photo so far, with most folders, by their names.
        photo: The name of the photo.
        reference: What the file calls it.
        file: The file.
    """
    other = named.setdefault(photo, reference)
    folders = [[part.casefold() for part in _parts(each)[:-1]] for each in (other, reference)]
    shorter, longer = sorted(folders, key=len)
    if folders[1] == longer:
        named[photo] = reference
    if longer[len(longer) - len(shorter) :] != shorter:
        raise InputError(
            f"{file} names both {other} and {reference}, which fit the same photo, {photo}; put the photos into the "
            "folders that they have there, or remove one of the two from the file."
        )


class Photos:
    """The photos of a capture.

    Programs refer to photos by a path on another computer, by a path from their own folder, or by a name, with or
    without suffix. Of a path, the longest part from the right that belongs to a photo is used, so that no reference
    leads out of the folder. A name alone may be that of a photo in any subfolder.

    Attributes:
        folder: their folder.
        names: their names, relative to it.
    """

    def __init__(self, capture: Path) -> None:
        self.folder = photos_folder(capture)
        self._files = photo_files(capture, self.folder)
        self.names = [path for path in self._files.paths if _split(path)[1]]
        self._by_stem: dict[str, list[str]] = {}
        self._by_name: dict[str, list[str]] = {}
        for path in self._files.paths:
            stem, suffix = _split(path)
            if suffix.lower() in IMAGES:
                self._by_stem.setdefault(stem.casefold(), []).append(path)
                for key in {path.rpartition("/")[2], stem.rpartition("/")[2]}:
                    self._by_name.setdefault(key.casefold(), []).append(path)

    def find(self, reference: str) -> str | None:
        """Return the name of a photo, relative to the folder, or None; of several that fit equally, none does."""
        fitting = self.fitting(reference)
        return fitting[0] if len(fitting) == 1 else None

    def fitting(self, reference: str) -> Sequence[str]:
        """Return the names of the photos that fit a reference equally, relative to the folder."""
        parts = _parts(reference)
        for start in range(len(parts)):
            end = "/".join(parts[start:])
            found = self._files.find(end)
            if found is not None and found.suffix.lower() in IMAGES:
                return (found.relative_to(self.folder).as_posix(),)
            of_stem = self._by_stem.get(end.casefold(), ())
            if len(of_stem) == 1:
                return of_stem
        if len(parts) != 1:
            return ()
        last = parts[-1].casefold()
        return self._by_name.get(last) or self._by_name.get(_split(last)[0]) or ()

    def size(self, name: str) -> tuple[int, int]:
        """Read the width and height of a photo; raises InputError with its path."""
        return image_size(self.folder / name)


def _parts(path: str) -> list[str]:
    """Return the names in a path, of folders and, at last, of the file."""
    return [part for part in re.split(r"[/\\]+", path) if part not in ("", ".", "..")]


def _split(path: str) -> tuple[str, str]:
    """Split a path into the part before the suffix of a photo, and that suffix, which may be empty."""
    stem, dot, suffix = path.rpartition(".")
    return (stem, dot + suffix) if stem and dot + suffix.lower() in IMAGES else (path, "")
