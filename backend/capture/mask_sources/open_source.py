"""Recognition of the program that wrote masks."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...shared.errors import InputError
from ...shared.formats.json_file import parse_json
from ...shared.formats.regular_file import read_regular
from ..files import Files
from ..models.photos import Photos
from ..xml_text import parse_xml
from . import coco, cvat, label_studio
from .exr import ExrMasks
from .images import MaskFiles, MaskFolders
from .segments import MaskSource

_LARGEST = 1 << 30
_MODELS = (".pt", ".pth")
"""Suffixes of files that PyTorch writes, as those in which models are published first."""
_ACCEPTED = (
    "expected a file of COCO, CVAT or Label Studio; or a folder with files named like the photos: PNG or NumPy files "
    "with IDs, black and white images, EXR with Cryptomatte or object indices, or folders of black and white images; "
    "or a folder with a checkpoint of SAM"
)


def open_source(path: Path, capture: Path, names: Sequence[str]) -> MaskSource:
    """Open the masks that a program wrote.

    Args:
        path: the file or folder.
        capture: the capture, in whose images/ its photos are.
        names: the names of the capture's photos.

    Raises:
        InputError: it is not of a known kind, is damaged, has masks of none of the photos, or is a model as published
            first.
    """
    photos = Photos(capture)
    if not path.exists():
        raise InputError(f"{path} does not exist; {_ACCEPTED}.")
    is_folder = path.is_dir()
    has_model = any(each.suffix.lower() in _MODELS for each in (path.iterdir() if is_folder else (path,)))
    if has_model and not is_folder:
        raise _unreadable_model(path)
    sources = _of_folder(path, photos, names) if is_folder else [_of_file(path, photos)]
    source = max(sources, key=lambda each: len(each.photos))
    if not source.photos:
        if has_model:
            raise _unreadable_model(path)
        raise InputError(f"{path} has masks of none of the {len(names)} photos, such as {names[0]}; {_ACCEPTED}.")
    return source


def _unreadable_model(path: Path) -> InputError:
    """Return the error for a file of a model, or a folder with one, in place of masks."""
    return InputError(
        f"The model in {path} is a file {' or '.join(_MODELS)}, which cannot be read; download all files of it for the "
        "package transformers to a folder, such as those of facebook/sam2.1-hiera-tiny."
    )


def _of_file(path: Path, photos: Photos) -> MaskSource:
    try:
        data = read_regular(path, _LARGEST)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read ({getattr(error, 'strerror', None) or error}).") from error
    try:
        if path.suffix.lower() == ".xml":
            root = parse_xml(data)
            if root.tag == "annotations":
                return cvat.CvatMasks(root, path, photos)
        elif path.suffix.lower() == ".json":
            content: Any = parse_json(data.decode("utf-8-sig"))
            if coco.recognizes(content):
                return coco.CocoMasks(content, path, photos)
            if label_studio.recognizes(content):
                return label_studio.LabelStudioMasks(content, path, photos)
    except ValueError as error:
        why = str(error) if path.suffix.lower() == ".xml" else f"is not valid JSON ({error})"
        raise InputError(f"{path} {why}; export it again.") from error
    raise InputError(f"{path} is not a file of masks that can be read; {_ACCEPTED}.")


def _of_folder(path: Path, photos: Photos, names: Sequence[str]) -> list[MaskSource]:
    files = Files(path)
    exr = {}
    for name in files.paths:
        stem, _, suffix = name.rpartition(".")
        if suffix.lower() == "exr" and (photo := photos.find(stem)) is not None:
            exr[photo] = path / name
    found: list[MaskSource] = [
        ExrMasks(exr), MaskFiles(path, names, photos.folder), MaskFolders(path, photos), coco.PhotoJson(path, photos)
    ]  # fmt: skip
    described = [path / name for name in files.paths if re.fullmatch(r"[^/]+\.(json|xml)", name, re.IGNORECASE)]
    if len(described) == 1 and described[0].stem not in ("labels", "masks", "config"):
        try:
            found.append(_of_file(described[0], photos))
        except InputError:
            # The masks beside such a file can be used without it.
            if not any(each.photos for each in found):
                raise
    return found
