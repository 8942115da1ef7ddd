"""OpenEXR files: Cryptomatte, of any renderer or compositing program, and passes of object indices."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from ...shared.errors import InputError
from .segments import Segments, checked_size

_OBJECT_INDEX = re.compile(r"(.*\.)?(IndexOB|object[ _]?(index|id)|id)(\.[XYRV])?", re.IGNORECASE)
_MATERIAL_INDEX = re.compile(r"(.*\.)?(IndexMA|material[ _]?index)(\.[XYRV])?", re.IGNORECASE)
_COVERED = 0.5
"""A pixel shows an object that covers more of it than this."""


class ExrMasks:
    """The masks of EXR files.

    Args:
        files: the file of each photo by its name.
    """

    what = "EXR masks"

    def __init__(self, files: dict[str, Path]) -> None:
        self._files = files
        self.photos: Sequence[str] = sorted(files)

    def read(self, photo: str) -> Segments:
        """Return the segments of a photo; raises InputError."""
        path = self._files[photo]
        try:
            with OpenEXR.File(str(path), separate_channels=True) as file:
                # Blender writes a part for each pass, and describes Cryptomatte in the first one only.
                header = {key: value for part in file.parts for key, value in part.header.items()}
                channels = {
                    name: _in_display(np.array(each.pixels), part.header, path)
                    for part in file.parts
                    for name, each in part.channels.items()
                }
        except (OSError, RuntimeError, ValueError, TypeError) as error:
            raise InputError(f"{path} cannot be read as OpenEXR ({error}); render it again.") from error
        found = _cryptomatte(header, channels) or _indices(channels)
        if found is None:
            raise InputError(
                f"{path} contains neither Cryptomatte nor a pass of object indices; its channels are "
                f"{', '.join(sorted(channels)[:10])}."
            )
        return found


def _in_display(pixels: np.ndarray, header: dict[str, Any], path: Path) -> np.ndarray:
    """Return pixels (h, w) of the data window in the display window, which is the photo; 0 where there are none."""
    (left, top), _ = header["dataWindow"]
    (first_x, first_y), (last_x, last_y) = header["displayWindow"]
    width, height = checked_size(int(last_x) - int(first_x) + 1, int(last_y) - int(first_y) + 1, str(path))
    x, y = int(left) - int(first_x), int(top) - int(first_y)
    shown = np.zeros((height, width), pixels.dtype)
    inside = pixels[max(-y, 0) : max(height - y, 0), max(-x, 0) : max(width - x, 0)]
    shown[max(y, 0) :, max(x, 0) :][: inside.shape[0], : inside.shape[1]] = inside
    return shown


def _cryptomatte(header: dict[str, Any], channels: dict[str, np.ndarray]) -> Segments | None:
    """Return the objects that cover most of each pixel; None without Cryptomatte. Objects come before materials."""
    layers = sorted(
        (str(name) for key, name in header.items() if re.fullmatch(r"cryptomatte/[^/]+/name", key)),
        key=lambda name: ("object" not in name.lower(), "asset" not in name.lower(), name),
    )
    # Cycles names the channels in lower case, and other programs in upper case.
    planes = {name.lower(): plane for name, plane in channels.items()}
    layer = next((name for name in layers if {f"{name}00.r".lower(), f"{name}00.g".lower()} <= planes.keys()), None)
    if layer is None:
        return None
    ids = np.ascontiguousarray(planes[f"{layer}00.r".lower()], np.float32).view(np.uint32)
    covered = planes[f"{layer}00.g".lower()] > _COVERED
    key = next(key for key, name in header.items() if str(name) == layer and key.endswith("/name"))
    try:
        manifest = json.loads(header.get(key.removesuffix("name") + "manifest") or "{}")
        names = {int(value, 16): str(name) for name, value in manifest.items()}
    except (AttributeError, TypeError, ValueError):
        names = {}
    found, numbers = np.unique(np.where(covered, ids, 0), return_inverse=True)
    return _numbered(found, numbers.reshape(ids.shape), lambda value: names.get(value, f"{value:08x}"), names)


def _indices(channels: dict[str, np.ndarray]) -> Segments | None:
    """Return the objects of a pass of indices; None without one. Objects come before materials."""
    kinds = (_OBJECT_INDEX, _MATERIAL_INDEX)
    name = next((name for kind in kinds for name in sorted(channels) if kind.fullmatch(name)), None)
    if name is None:
        return None
    indices = np.rint(np.nan_to_num(channels[name].astype(np.float64))).astype(np.int64)
    found, numbers = np.unique(np.maximum(indices, 0), return_inverse=True)
    return _numbered(found, numbers.reshape(indices.shape), lambda value: value, {})


def _numbered(
    found: np.ndarray, numbers: np.ndarray, object_of: Callable[[int], Hashable], names: dict[int, str]
) -> Segments:
    """Return segments from indices (h, w) into the values found, of which 0 is no object."""
    offset = 0 if len(found) and found[0] == 0 else 1
    values = found[1 - offset :].tolist()
    return Segments(
        (numbers + offset).astype(np.int32), list(map(object_of, values)), [names.get(value, "") for value in values]
    )
