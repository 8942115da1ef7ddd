"""Label Studio's JSON: brushes, polygons, rectangles and ellipses."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from ...shared.errors import InputError
from ..models.photos import Photos, require_single
from .segments import Segments, Shape, checked_size, draw_shapes, polygon, turned

_UPLOAD = re.compile(r"^[0-9a-f]{8}-")
_UPLOADED = re.compile(r"^(.*/upload/\d+/)?[0-9a-f]{8}-")
_SHAPE = ("x", "y", "width", "height", "radiusX", "radiusY", "points", "rle")
_LABELS = ("brushlabels", "polygonlabels", "rectanglelabels", "ellipselabels", "labels")


def recognizes(content: Any) -> bool:
    """Return whether JSON is of Label Studio: a list of tasks with annotations."""
    return (
        isinstance(content, list)
        and bool(content)
        and all(isinstance(task, Mapping) and isinstance(task.get("annotations"), list) for task in content)
    )


class LabelStudioMasks:
    """The masks of an export of Label Studio.

    Args:
        content: its JSON.
        file: the file, for messages.
        photos: the photos of the capture.

    Raises:
        InputError: the file is not valid.
    """

    what = "Label Studio annotations"

    def __init__(self, content: Sequence[Mapping[str, Any]], file: Path, photos: Photos) -> None:
        self._file = file
        self._results: dict[str, list[Mapping[str, Any]]] = {}
        uploaded: dict[str, list[str]] = {}
        named: dict[str, str] = {}
        for path in photos.names:
            uploaded.setdefault(_as_uploaded(path.rpartition("/")[2]), []).append(path)
        try:
            for task in content:
                name, reference = _photo_of(task, photos, uploaded)
                regions = [each for annotation in task["annotations"] for each in _regions(annotation["result"])]
                # Photos that nobody has annotated yet are listed, too.
                if name is not None and regions:
                    # The folder of an upload is none of the photo.
                    require_single(named, name, _UPLOADED.sub("", reference), file)
                    self._results[name] = regions
        except (AttributeError, KeyError, TypeError) as error:
            raise self._invalid(error) from error
        self.photos: Sequence[str] = sorted(self._results)
        self._is_unique = all(
            count == 1 for found in self._results.values() for count in Counter(map(_label, found)).values()
        )

    def read(self, photo: str) -> Segments:
        """Return the segments of a photo; raises InputError."""
        results, shapes = self._results[photo], []
        try:
            size = checked_size(results[0]["original_width"], results[0]["original_height"], f"{self._file}: {photo}")
            for each in results:
                label = _label(each)
                shapes.append(Shape.of(_inside(each, size), label if label and self._is_unique else None, label))
        except (AttributeError, KeyError, TypeError, ValueError, IndexError) as error:
            raise self._invalid(error, photo) from error
        return draw_shapes(shapes, size)

    def _invalid(self, error: Exception, photo: str = "") -> InputError:
        where = f" for {photo}" if photo else ""
        return InputError(f"{self._file} is not valid{where} ({error}); export it again from Label Studio as JSON.")


def _photo_of(task: Mapping[str, Any], photos: Photos, uploaded: Mapping[str, Sequence[str]]) -> tuple[str | None, str]:
    """Return the photo of a task, and what it is called there; None if there is no such photo.

    Args:
        task: the task.
        photos: the photos of the capture.
        uploaded: the photos by the names that Label Studio gives them when they are uploaded, before which it sets
            eight digits.
    """
    given = [each for each in (*task["data"].values(), task.get("file_upload")) if isinstance(each, str)]
    for value in dict.fromkeys([*given, *(unquote(each.rpartition("?d=")[2]) for each in given)]):
        name = value.rpartition("/")[2]
        found = photos.find(value) or photos.find(name) or photos.find(_UPLOAD.sub("", name))
        if found is None and _UPLOAD.match(name):
            fitting = uploaded.get(_UPLOAD.sub("", name), ())
            found = fitting[0] if len(fitting) == 1 else None
        if found is not None:
            return found, value
    return None, ""


def _regions(results: Sequence[Mapping[str, Any]]) -> Sequence[Mapping[str, Any]]:
    """Return one result for each region, whose label, text and others are results, too, with the same shape and id."""
    regions: dict[Any, list[dict[str, Any]]] = {}
    for number, each in enumerate(results):
        if "original_width" in each:
            # Scripts may give several regions one id.
            own = regions.setdefault(each.get("id") or (number,), [])
            region = next((other for other in own if _shape(other) == _shape(each) or not _shape(each)), None)
            if region is None:
                own.append(region := {**each, "value": {}})
            region["value"] = {**each["value"], **region["value"]}
    return [region for own in regions.values() for region in own]


def _shape(result: Mapping[str, Any]) -> Mapping[str, Any]:
    return {key: value for key, value in result["value"].items() if key in _SHAPE}


def _as_uploaded(name: str) -> str:
    """Return what Label Studio makes of the name of a file that is uploaded: Django's `get_valid_filename`."""
    return re.sub(r"[^-\w.]", "", name.strip().replace(" ", "_"))


def _label(result: Mapping[str, Any]) -> str:
    value = result.get("value", {})
    return next((str(value[key][0]) for key in _LABELS if value.get(key)), "")


def _inside(result: Mapping[str, Any], size: tuple[int, int]) -> np.ndarray:
    """Return the pixels (h, w) bool of a region."""
    value, (width, height) = result["value"], size
    if "rle" in value:
        return unpack(value["rle"], width * height * 4).reshape(height, width, 4)[..., 3] > 0
    if "points" in value:
        return polygon([(x / 100 * width, y / 100 * height) for x, y in value["points"]], size)
    x, y = value["x"] / 100 * width, value["y"] / 100 * height
    degrees = float(value.get("rotation", 0.0))
    if "radiusX" in value:
        turns = np.linspace(0, 2 * np.pi, 64, endpoint=False)
        across = x + value["radiusX"] / 100 * width * np.cos(turns)
        down = y + value["radiusY"] / 100 * height * np.sin(turns)
        return polygon(turned(list(zip(across.tolist(), down.tolist(), strict=True)), degrees, (x, y)), size)
    right, bottom = x + value["width"] / 100 * width, y + value["height"] / 100 * height
    return polygon(turned([(x, y), (right, y), (right, bottom), (x, bottom)], degrees, (x, y)), size)


def unpack(data: Sequence[int], count: int) -> np.ndarray:
    """Decode the run lengths of Label Studio's brushes, those of the package @thi.ng/rle-pack.

    The bits are: the number of values (32), the bits of a value less 1 (5), and four times the bits of a length less 1
    (4). Then follow runs: whether it repeats one value (1), which size its length has (2), the length less 1, and the
    value or the values.

    Args:
        data: bytes.
        count: expected number of values.

    Returns:
        (count,) uint8.

    Raises:
        ValueError: The data is damaged.
    """
    bits = np.unpackbits(np.array(data, np.uint8)).tolist()
    at = 0

    def take(length: int) -> int:
        nonlocal at
        if at + length > len(bits):
            raise ValueError("a brush that ends too early")
        value = 0
        for bit in bits[at : at + length]:
            value = value << 1 | bit
        at += length
        return value

    total, word = take(32), take(5) + 1
    sizes = [take(4) + 1 for _ in range(4)]
    if total != count or word > 8:
        raise ValueError(f"a brush of {total} values, expected {count}")
    values = np.zeros(count, np.uint8)
    first = 0
    while first < count:
        repeats, length = take(1), take(sizes[take(2)]) + 1
        last = first + length
        if last > count:
            raise ValueError("a brush that is too long")
        values[first:last] = take(word) if repeats else [take(word) for _ in range(length)]
        first = last
    return values
