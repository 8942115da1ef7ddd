"""Strokes of the user on objects in photos, and their file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from ..shared.errors import InputError
from ..shared.formats.json_file import read_json
from ..shared.reconstruction.objects import LARGEST_ID


@dataclass(frozen=True)
class Stroke:
    """A stroke on an object.

    Attributes:
        object: ID of the object; 0 for what belongs to none.
        view: name of the photo.
        points: the corners (x, y) of the stroke, as fractions of the undistorted photo's width and height from its top
            left corner; one point is a click.
    """

    object: int
    view: str
    points: tuple[tuple[float, float], ...]

    def pixels(self, width: int, height: int) -> np.ndarray:
        """Return the pixels that the stroke covers in an image of this size, (height, width) bool."""
        image = Image.new("1", (width, height))
        # The center of the last pixel is half a pixel inside the image.
        corners = [(min(int(x * width), width - 1), min(int(y * height), height - 1)) for x, y in self.points]
        ImageDraw.Draw(image).line(corners, fill=1)
        ImageDraw.Draw(image).point(corners, fill=1)
        return np.array(image)


@dataclass(frozen=True)
class Strokes:
    """The strokes of a file.

    Attributes:
        strokes: the strokes, in the order in which they were made.
        names: names of objects by ID.
    """

    strokes: tuple[Stroke, ...]
    names: dict[int, str]


def read_strokes(path: Path, views: Sequence[str]) -> Strokes:
    """Read a file of strokes.

    The file is a JSON object: `strokes` is a list of objects with `object` (an ID), `view` (the name of a photo) and
    `points` (a list of [x, y], fractions of the undistorted photo's width and height); `objects` may name the IDs.

    Args:
        path: the file.
        views: names of the capture's photos.

    Returns:
        The strokes.

    Raises:
        InputError: the file cannot be read, or a stroke is not valid.
    """
    content = read_json(path)
    entries = content.get("strokes") if isinstance(content, Mapping) else None
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path} contains no strokes; it must have a list `strokes` with at least one.")
    known = set(views)
    strokes = tuple(_stroke(entry, f"Stroke {number} of {path}", known) for number, entry in enumerate(entries, 1))
    if not any(stroke.object for stroke in strokes):
        raise InputError(f"{path} marks no object, since all its strokes have the ID 0; mark at least one object.")
    return Strokes(strokes, _names(content.get("objects", {}), path))


def _stroke(entry: Any, where: str, views: set[str]) -> Stroke:
    if not isinstance(entry, Mapping):
        raise InputError(f"{where} is no JSON object; it needs `object`, `view` and `points`.")
    object_id, view, points = entry.get("object"), entry.get("view"), entry.get("points")
    if not isinstance(object_id, int) or isinstance(object_id, bool) or not 0 <= object_id <= LARGEST_ID:
        raise InputError(f"{where} has the object {object_id!r}; an ID is a whole number from 0 to {LARGEST_ID}.")
    if not isinstance(view, str) or view not in views:
        raise InputError(f"{where} is on the photo {view!r}, which the capture does not have; name one of its photos.")
    if not isinstance(points, list) or not points or not all(map(_is_point, points)):
        raise InputError(f"{where} needs `points`, a list of [x, y] with fractions from 0 to 1 of the photo's size.")
    return Stroke(object_id, view, tuple((float(x), float(y)) for x, y in points))


def _is_point(point: Any) -> bool:
    if not isinstance(point, list) or len(point) != 2:
        return False
    return all(isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value <= 1 for value in point)


def _names(named: Any, path: Path) -> dict[int, str]:
    if not isinstance(named, Mapping) or not all(isinstance(name, str) and name for name in named.values()):
        raise InputError(f'{path} must have the objects\' names by ID in `objects`, such as {{"1": "mug"}}.')
    if not all(key.isdecimal() and 0 < int(key) <= LARGEST_ID for key in named):
        raise InputError(f"{path} names an object in `objects` by something else than an ID from 1 to {LARGEST_ID}.")
    return {int(key): name for key, name in named.items()}
