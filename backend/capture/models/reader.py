"""Search of a capture for the model of its cameras, COLMAP's first, and reading of it."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ...shared.errors import InputError
from ...shared.formats.photos_source import IMAGES
from ...shared.formats.regular_file import open_regular
from ..colmap import Model, find_model, has_model, read_model
from ..files import Files
from . import bundler, metashape, realityscan, transforms

_FORMATS: tuple[tuple[str, str, Callable[[bytes], bool], Callable[[Path], Model]], ...] = (
    ("a transforms.json", r"transforms\.json", transforms.recognizes, transforms.read),
    ("a Bundler file", r".*\.out", bundler.recognizes, bundler.read),
    ("a Metashape XML file", r".*\.xml", metashape.recognizes, metashape.read),
    ("a RealityScan CSV file", r".*\.csv", realityscan.recognizes, realityscan.read),
)
"""What is looked for without a complete COLMAP model, in this order: name, file name, test of the start, reader."""

_HEAD = 4096


def read_capture_model(folder: Path) -> Model:
    """Find and read the model of a capture.

    Args:
        folder: The capture, with a COLMAP model as for `find_model`, or a file of another program beside the photos:
            transforms.json, a Bundler file (.out), Metashape's cameras (.xml) or RealityScan's (.csv).

    Returns:
        The model, whose warnings include those about the choice of the model.

    Raises:
        InputError: There is no model, or it cannot be used; the message names the file.
    """
    incomplete: InputError | None = None
    try:
        if has_model(folder):
            try:
                chosen, warnings = find_model(folder)
            except InputError as error:  # Other programs, too, write files such as cameras.txt.
                incomplete = error
            else:
                model = _with_names_of_files(read_model(chosen), folder / "images")
                model.warnings[:0] = warnings
                return model
        files = _files_in(folder)
        photos = [path for path in (*files, *_files_in(folder / "images")) if path.suffix.lower() in IMAGES]
    except OSError as error:
        raise InputError(f"{error.filename or folder} cannot be read ({error.strerror}); check it.") from error
    unreadable = []
    for what, pattern, recognizes, read in _FORMATS:
        found = []
        for path in files:
            if not re.fullmatch(pattern, path.name, re.IGNORECASE):
                continue
            try:
                with open_regular(path) as file:
                    head = file.read(_HEAD)
            except OSError as error:
                unreadable.append(f"{path} cannot be read ({error.strerror}); check the file.")
                continue
            if recognizes(head):
                found.append(path)
        if len(found) > 1:
            names = " and ".join(path.name for path in found[:2])
            raise InputError(f"{folder} contains {names}, each {what} with cameras; leave only one of them there.")
        if found:
            return read(found[0])
    if incomplete is not None:
        raise incomplete
    if unreadable:
        raise InputError(unreadable[0])
    if _is_inside_capture(folder):
        raise InputError(f"{folder} is a part of a capture; choose the folder above, {folder.parent}.")
    photos = photos or _photos_below(folder)
    if photos:
        raise InputError(
            f"{folder} contains {len(photos)} photos, but not where they were taken; compute that with Import "
            "Photos or Video (on the command line: `sfm`), or save the cameras of COLMAP, RealityScan or Metashape "
            f"there, for instance COLMAP's model in {folder / 'sparse' / '0'}."
        )
    raise InputError(
        f"{folder} contains no COLMAP model: expected cameras, images and points3D (.bin or .txt) in "
        f"{folder / 'sparse' / '0'}, or the cameras as transforms.json, Bundler's .out, Metashape's .xml or "
        "RealityScan's .csv."
    )


def _photos_below(folder: Path) -> list[Path]:
    """Return the images in the folders of a folder, except those of masks; none if it cannot be read."""
    with contextlib.suppress(OSError):
        folders = [path for path in folder.iterdir() if path.is_dir() and path.name not in ("images", "masks")]
        return [path for each in folders for path in _files_in(each) if path.suffix.lower() in IMAGES]
    return []


def _with_names_of_files(model: Model, images: Path) -> Model:
    """Return a model that names its images from another folder than images/ by their names in it.

    COLMAP names images relative to the folder that it was given, which may be any folder above.
    """
    files = Files(images)
    if not files.paths or any(files.find(image.name) for image in model.images):
        return model
    found = [(image, files.find_end(image.name)) for image in model.images]
    paths = [path for _, path in found if path is not None]
    if not paths or len(set(paths)) < len(paths):
        return model
    named = [replace(image, name=path.relative_to(images).as_posix()) for image, path in found if path is not None]
    return replace(model, images=named, absent=tuple(image.name for image, path in found if path is None))


def _is_inside_capture(folder: Path) -> bool:
    """Return whether a folder without a model is images/ or masks/ of a capture with one."""
    above = folder.parent
    if folder.name.lower() not in ("images", "masks"):
        return False
    try:
        return has_model(above) or any(
            re.fullmatch(pattern, path.name, re.IGNORECASE) for path in _files_in(above) for _, pattern, *_ in _FORMATS
        )
    except OSError:
        return False


def _files_in(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if not path.is_dir()) if folder.is_dir() else []
