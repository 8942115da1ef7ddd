"""Strokes of the user on objects in photos, and their file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from PIL import Image, ImageDraw
from scipy.ndimage import distance_transform_edt

from ..shared.errors import InputError
from ..shared.formats.json_file import read_json
from ..shared.reconstruction.objects import LARGEST_ID

PARTS = 2**16
"""Largest number of parts of an object."""

_LARGEST = 16384
"""Largest width and height of a viewpoint's image in pixels."""


@dataclass(frozen=True)
class Viewpoint:
    """A camera that is not one of the capture's, such as that of a viewport.

    Attributes:
        viewmat: rows of the (4, 4) map from the capture's coordinates to the camera's, OpenCV axes.
        intrinsics: fx, fy, cx, cy in pixels.
        width, height: size of the image in pixels.
    """

    viewmat: tuple[tuple[float, ...], ...]
    intrinsics: tuple[float, float, float, float]
    width: int
    height: int


@dataclass(frozen=True)
class Stroke:
    """A stroke on an object.

    Attributes:
        object: ID of the object; 0 for what belongs to none.
        view: name of the photo, or the viewpoint that it was drawn from.
        points: the corners (x, y) of the stroke, as fractions of the undistorted photo's width and height from its top
            left corner; one point is a click.
        area: whether everything inside of the line is meant, which is closed then.
        part: number of the object's part that it is on. Parts were objects once, and merging these left each as it was.
        exact: whether the stroke stands for no more than it covers, even if there is a segmentation model.
    """

    object: int
    view: str | Viewpoint
    points: tuple[tuple[float, float], ...]
    area: bool = False
    part: int = 0
    exact: bool = False

    def pixels(self, width: int, height: int) -> np.ndarray:
        """Return the pixels that the stroke covers in an image of this size, (height, width) bool."""
        image = Image.new("1", (width, height))
        # The center of the last pixel is half a pixel inside the image.
        corners = [(min(int(x * width), width - 1), min(int(y * height), height - 1)) for x, y in self.points]
        if self.area and len(corners) > 2:
            ImageDraw.Draw(image).polygon(corners, fill=1, outline=1)
        ImageDraw.Draw(image).line(corners, fill=1)
        ImageDraw.Draw(image).point(corners, fill=1)
        return np.array(image)


@dataclass(frozen=True)
class Strokes:
    """The strokes of a file.

    Attributes:
        strokes: the strokes, in the order in which they were made.
        names: names of objects by ID.
        everything: whether everything belongs to one of the objects; otherwise, what is far from the strokes does not.
    """

    strokes: tuple[Stroke, ...]
    names: dict[int, str]
    everything: bool = False


def stroke_through(mask: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ends (x, y), as fractions of the size, of a stroke through the widest part of a mask (H, W).

    It is along the row through the middle of the largest inscribed circle, without a fifth at both ends.
    """
    inside = distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    row, column = np.unravel_index(inside.argmax(), mask.shape)
    gaps = np.flatnonzero(~np.pad(mask[row], 1, constant_values=False)) - 1
    first, last = gaps[gaps < column].max() + 1, gaps[gaps > column].min() - 1
    margin = (last - first) // 5
    height, width = mask.shape
    y = float((row + 0.5) / height)
    return (float((first + margin + 0.5) / width), y), (float((last - margin + 0.5) / width), y)


def content_of(strokes: Strokes) -> dict[str, Any]:
    """Return the content of a file of strokes, as `strokes_of` reads it."""
    return {
        "objects": {str(object_id): name for object_id, name in strokes.names.items()},
        "everything": strokes.everything,
        "strokes": [
            {
                "object": stroke.object, **_place(stroke.view), "points": [list(point) for point in stroke.points],
                **({"exact": True} if stroke.exact else {}),
            }
            for stroke in strokes.strokes
        ],
    }  # fmt: skip


def _place(view: str | Viewpoint) -> dict[str, Any]:
    """Return the entry of a stroke that says where it was drawn."""
    if isinstance(view, str):
        return {"view": view}
    camera = {"viewmat": [list(row) for row in view.viewmat], "intrinsics": list(view.intrinsics)}
    return {"camera": {**camera, "width": view.width, "height": view.height}}


def read_strokes(path: Path, views: Sequence[str]) -> Strokes:
    """Read a file of strokes.

    The file is a JSON object. `strokes` is a list of objects with `object` (an ID), `points` (a list of [x, y],
    fractions of the image's width and height) and either `view` (the name of a photo, undistorted) or `camera` (with
    `viewmat` (4, 4), `intrinsics` fx, fy, cx and cy, `width` and `height`); `area` and `exact` may be true, and `part`
    the number of a part of the object. `objects` may name the IDs, and `everything` may be true.

    Args:
        path: the file.
        views: names of the capture's photos.

    Returns:
        The strokes.

    Raises:
        InputError: the file cannot be read, or a stroke is not valid.
    """
    found = strokes_of(read_json(path), str(path), views)
    if not any(stroke.object for stroke in found.strokes):
        raise InputError(f"{path} marks no object, since all its strokes have the ID 0; mark at least one object.")
    return found


def strokes_of(content: Any, source: str, views: Sequence[str]) -> Strokes:
    """Return the strokes in the content of a file; source: its name for errors. Raises as `read_strokes`."""
    entries = content.get("strokes") if isinstance(content, Mapping) else None
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{source} contains no strokes; it must have a list `strokes` with at least one.")
    known = set(views)
    strokes = tuple(_stroke(entry, f"Stroke {number} of {source}", known) for number, entry in enumerate(entries, 1))
    everything = content.get("everything", False)
    if not isinstance(everything, bool):
        raise InputError(f"{source} has {everything!r} as `everything`; it must be true or false.")
    return Strokes(strokes, _names(content.get("objects", {}), source), everything)


def _stroke(entry: Any, where: str, views: set[str]) -> Stroke:
    if not isinstance(entry, Mapping):
        raise InputError(f"{where} is no JSON object; it needs `object`, `points`, and `view` or `camera`.")
    object_id, points, area = entry.get("object"), entry.get("points"), entry.get("area", False)
    part, exact = entry.get("part", 0), entry.get("exact", False)
    if not _is_number(object_id, LARGEST_ID):
        raise InputError(f"{where} has the object {object_id!r}; an ID is a whole number from 0 to {LARGEST_ID}.")
    if not _is_number(part, PARTS - 1):
        raise InputError(f"{where} has the part {part!r}; it must be a whole number from 0 to {PARTS - 1}.")
    if not isinstance(points, list) or not points or not all(map(_is_point, points)):
        raise InputError(f"{where} needs `points`, a list of [x, y] with fractions from 0 to 1 of the image's size.")
    for key, value in (("area", area), ("exact", exact)):
        if not isinstance(value, bool):
            raise InputError(f"{where} has {value!r} as `{key}`; it must be true or false.")
    seen_from = _viewpoint(entry["camera"], where) if "camera" in entry else entry.get("view")
    if isinstance(seen_from, str) and seen_from not in views:
        raise InputError(f"{where} is on the photo {seen_from!r}, which the capture lacks; name one of its photos.")
    if not isinstance(seen_from, str | Viewpoint):
        raise InputError(f"{where} needs `view`, the name of a photo, or `camera`.")
    return Stroke(object_id, seen_from, tuple((float(x), float(y)) for x, y in points), area, part, exact)


def _viewpoint(camera: Any, where: str) -> Viewpoint:
    try:
        viewmat = np.array(camera["viewmat"], np.float64)
        intrinsics = np.array(camera["intrinsics"], np.float64)
        width, height = camera["width"], camera["height"]
        # A map that stretches space is not a camera's.
        good = (
            viewmat.shape == (4, 4)
            and intrinsics.shape == (4,)
            and bool(np.isfinite(viewmat).all() and np.isfinite(intrinsics).all() and (intrinsics[:2] > 0).all())
            and np.allclose(viewmat[:3, :3] @ viewmat[:3, :3].T, np.eye(3), atol=1e-3)
            and all(isinstance(size, int) and 0 < size <= _LARGEST for size in (width, height))
        )
    except (KeyError, TypeError, ValueError):
        good = False
    if not good:
        raise InputError(
            f"{where} needs a `camera` with `viewmat` (4 x 4, without scale), `intrinsics` (fx, fy, cx, cy), `width` "
            "and `height`."
        )
    fx, fy, cx, cy = intrinsics.tolist()
    return Viewpoint(tuple(map(tuple, viewmat.tolist())), (fx, fy, cx, cy), width, height)


def _is_number(value: Any, largest: int) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= largest


def _is_point(point: Any) -> bool:
    if not isinstance(point, list) or len(point) != 2:
        return False
    return all(isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value <= 1 for value in point)


def _names(named: Any, path: str) -> dict[int, str]:
    if not isinstance(named, Mapping) or not all(isinstance(name, str) and name for name in named.values()):
        raise InputError(f'{path} must have the objects\' names by ID in `objects`, such as {{"1": "mug"}}.')
    if not all(key.isdecimal() and 0 < int(key) <= LARGEST_ID for key in named):
        raise InputError(f"{path} names an object in `objects` by something else than an ID from 1 to {LARGEST_ID}.")
    return {int(key): name for key, name in named.items()}
