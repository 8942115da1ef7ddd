"""Photos of a folder as the images/ of a new capture, grouped by the camera that took them."""

from __future__ import annotations

import re
import shutil
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from PIL import ExifTags
from PIL import Image as PilImage

from ..capture.files import IMAGE_SUFFIXES, read_image, write_image
from ..shared.errors import InputError
from ..shared.formats.atomic import atomic_path, make_folder
from ..shared.stopping import StoppingReporter

IMAGES, MASKS = "images", "masks"
COPIED = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp"}
"""Suffixes of files that COLMAP reads; images of other formats are converted to PNG."""
_OTHER_FILES = re.compile(r"(labels?|classes|names|test)[\w.-]*\.(json|txt|csv)", re.IGNORECASE)
_LEAST_FREE = 1.2
"""Free space on the disk, relative to the size of the photos, below which they are not copied."""


class Photo(NamedTuple):
    """A photo of a capture.

    Attributes:
        name: path within images/, with slashes.
        camera: what photos of one camera with one focal length have in common.
    """

    name: str
    camera: str


def take_photos(source: Path, capture: Path, reporter: StoppingReporter) -> tuple[list[Photo], dict[str, str]]:
    """Copy the photos of a folder to the images/ of a capture, unless they are there.

    Args:
        source: a folder with photos, also in subfolders, or with a folder images/ and, optionally, masks/ and files
            with names, which are copied, too.
        capture: the capture's folder.
        reporter: receives progress.

    Returns:
        The photos in natural order of their names, and name -> reason for files that cannot be read.

    Raises:
        InputError: There are fewer than two photos, or too little space on the disk.
    """
    base = source / IMAGES if (source / IMAGES).is_dir() else source
    found = _listed(base, capture)
    if len(found) < 2:
        count = "only one photo" if found else "no photos"
        raise InputError(f"{base} contains {count}; poses need at least two photos of the same scene.")
    images = capture / IMAGES
    in_place = base.resolve() == images.resolve()
    if not in_place:
        _require_space(found, capture)
    photos, unreadable = [], {}
    for number, path in enumerate(found):
        reporter.progress(number, len(found))
        relative = path.relative_to(base)
        try:
            photo = _described(path, relative)
            if not in_place:
                relative = _copied(path, relative, images)
            photos.append(photo._replace(name=relative.as_posix()))
        except InputError as error:
            unreadable[relative.as_posix()] = str(error)
    if len(photos) < 2:
        raise InputError(f"Of the photos in {base}, {len(photos)} can be read; {next(iter(unreadable.values()))}")
    if not in_place and base != source:
        _copy_rest(source, capture)
    return photos, unreadable


def _listed(base: Path, capture: Path) -> list[Path]:
    """Return the photos below a folder in natural order, without those of the capture, if it is in the folder."""
    try:
        inside = capture.resolve()
        paths = [
            path
            for path in base.rglob("*")
            if path.suffix.lower() in IMAGE_SUFFIXES
            and not path.name.startswith(".")
            and path.is_file()
            and (base.resolve().is_relative_to(inside) or not path.resolve().is_relative_to(inside))
        ]
    except OSError as error:
        raise InputError(f"{error.filename or base} cannot be read ({error.strerror}); check it.") from error
    return sorted(paths, key=_natural)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Return a sort key by which photo 10 follows photo 9."""
    parts = re.split(r"(\d+)", path.as_posix().lower())
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]


def _require_space(paths: Sequence[Path], capture: Path) -> None:
    needed = sum(path.stat().st_size for path in paths)
    existing = next(folder for folder in (capture, *capture.absolute().parents) if folder.exists())
    free = shutil.disk_usage(existing).free
    if free < _LEAST_FREE * needed:
        raise InputError(
            f"The photos need {needed / 1e9:.1f} GB and the disk of {existing} has {free / 1e9:.1f} GB free; make "
            "room, or choose another --out."
        )


def _described(path: Path, relative: Path) -> Photo:
    """Return a photo with its camera: folder, size and, where EXIF tells them, maker, model and focal length."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with PilImage.open(path) as image:
                size, exif = image.size, image.getexif()
                image.draft("L", (64, 64))  # Decodes a JPEG at an eighth of its size.
                image.load()
    except Exception as error:
        raise InputError(f"{path.name} cannot be read as an image: it is damaged or its format is unknown.") from error
    details = exif.get_ifd(ExifTags.IFD.Exif)
    maker = [str(exif.get(tag, "")).strip("\0 ") for tag in (ExifTags.Base.Make, ExifTags.Base.Model)]
    focal = details.get(ExifTags.Base.FocalLength, "")
    return Photo(relative.as_posix(), " ".join([str(relative.parent), f"{size[0]}x{size[1]}", *maker, str(focal)]))


def _copied(path: Path, relative: Path, images: Path) -> Path:
    """Copy or convert a photo, unless that was done, and return its path within images/."""
    relative = relative if path.suffix.lower() in COPIED else relative.with_suffix(".png")
    target = images / relative
    if target.exists():
        return relative
    make_folder(target.parent)
    if path.suffix.lower() in COPIED:
        with atomic_path(target) as part:
            shutil.copyfile(path, part)
    else:
        write_image(target, read_image(path))
    return relative


def _copy_rest(source: Path, capture: Path) -> None:
    """Copy masks and files with names that are beside the photos."""
    masks = source / MASKS
    others = [path for path in source.iterdir() if path.is_file() and _OTHER_FILES.fullmatch(path.name)]
    for path in [*others, *(path for path in (masks.rglob("*") if masks.is_dir() else ()) if path.is_file())]:
        target = capture / path.relative_to(source)
        if not target.exists():
            make_folder(target.parent)
            with atomic_path(target) as part:
                shutil.copyfile(path, part)
