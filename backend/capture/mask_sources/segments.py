"""What the mask sources have in common: the segments of a photo, and shapes drawn as segments."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from pycocotools import mask as coco_masks

from ...shared.errors import InputError

LARGEST_SIDE = 32768
_FARTHEST = 1e9
"""Corners beyond are moved there, far outside of all photos, so that products of them are finite."""


class Segments(NamedTuple):
    """The segments of a photo.

    Attributes:
        numbers: (h, w) int32, the number of each pixel's segment, from 1; 0: none.
        objects: for each segment, what has the same value in other photos of the same object; None if the source does
            not say.
        names: for each segment, the name that the source gives it, or "".
    """

    numbers: np.ndarray
    objects: Sequence[Hashable]
    names: Sequence[str]


class MaskSource(Protocol):
    """Masks of photos that a program wrote.

    Attributes:
        what: the kind of masks, such as "COCO annotations".
        photos: the names of the capture's photos that have masks.
    """

    what: str
    photos: Sequence[str]

    def read(self, photo: str) -> Segments:
        """Return the segments of a photo; raises InputError if they cannot be read."""
        ...


class Shape(NamedTuple):
    """One segment before it is drawn: the pixels (h, w) bool of its box, and its object and name as in `Segments`."""

    inside: np.ndarray
    box: tuple[slice, slice]
    object: Hashable
    name: str

    @classmethod
    def of(cls, inside: np.ndarray, which: Hashable, name: str) -> Shape:
        """Keep the box of a photo's pixels (H, W) bool, since those of all segments would take much memory."""
        box = _extent(np.any(inside, 1)), _extent(np.any(inside, 0))
        return cls(inside[box].copy(), box, which, name)


def _extent(line: np.ndarray) -> slice:
    """Return the part of a line (n,) bool from the first to the last pixel that is inside."""
    places = np.flatnonzero(line)
    return slice(int(places[0]), int(places[-1]) + 1) if len(places) else slice(0, 0)


def draw_shapes(shapes: Iterable[Shape], size: tuple[int, int]) -> Segments:
    """Draw the shapes of a photo of this size (width, height), the smaller ones over the larger ones."""
    numbers = np.zeros(size[::-1], np.int32)
    ordered = sorted((shape for shape in shapes if shape.inside.any()), key=lambda shape: -int(shape.inside.sum()))
    for number, shape in enumerate(ordered, 1):
        numbers[shape.box][shape.inside] = number
    return Segments(numbers, [shape.object for shape in ordered], [shape.name for shape in ordered])


def polygon(corners: Sequence[tuple[float, float]], size: tuple[int, int]) -> np.ndarray:
    """Return the pixels (h, w) bool whose centers are inside of a polygon.

    Args:
        corners: (x, y) in pixels from the edges of the photo, whose first pixel has its center at (0.5, 0.5). Shapes
            that touch have no pixel in common.
        size: Width and height of the photo.

    Raises:
        ValueError: A corner is not a number.
    """
    width, height = size
    points = np.array([(x, y) for x, y in corners], np.float64).reshape(-1, 2)
    if not np.isfinite(points).all():
        raise ValueError("a corner that is not a number")
    points = np.clip(points, -_FARTHEST, _FARTHEST)
    # A pixel is inside if an odd number of edges cross its row on its left.
    crossed = np.zeros((height, width + 1), bool)
    for edge in zip(points.tolist(), np.roll(points, -1, 0).tolist(), strict=True):
        # Always downwards, so that two shapes round an edge that they share alike.
        (x, top), (other_x, bottom) = sorted(edge, key=lambda corner: corner[1])
        first, last = (min(max(math.ceil(each - 0.5), 0), height) for each in (top, bottom))
        if first < last:
            rows = np.arange(first, last)
            across = x + (rows + 0.5 - top) * ((other_x - x) / (bottom - top))
            columns = np.clip(np.ceil(across - 0.5), 0, width).astype(np.int64)
            crossed[rows, columns] ^= True
    return np.logical_xor.accumulate(crossed, 1)[:, :width]


def turned(
    corners: Sequence[tuple[float, float]], degrees: float, about: tuple[float, float]
) -> list[tuple[float, float]]:
    """Return corners (x, y) in pixels, turned clockwise about a point of the image."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    x, y = about
    return [(x + cos * (u - x) - sin * (v - y), y + sin * (u - x) + cos * (v - y)) for u, v in corners]


def run_lengths(counts: Any, size: tuple[int, int]) -> np.ndarray:
    """Decode COCO's run lengths by columns: a list, or its compressed text.

    Raises:
        ValueError: They do not fit the size.
    """
    width, height = size
    if isinstance(counts, list):
        if any(not isinstance(count, int) or isinstance(count, bool) or count < 0 for count in counts):
            raise ValueError("run lengths that are not whole numbers")
        if sum(counts) != width * height:
            raise ValueError(f"run lengths of {sum(counts)} pixels for {width} x {height}")
        runs = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
        return runs.reshape(width, height).T
    if not isinstance(counts, str | bytes):
        raise ValueError("run lengths that are neither a list nor text")
    data = counts.encode("ascii") if isinstance(counts, str) else counts
    _check_compressed(data, width * height)
    return coco_masks.decode({"size": [height, width], "counts": data}).astype(bool)


def _check_compressed(data: bytes, pixels: int) -> None:
    """Raise ValueError unless compressed run lengths add up to a number of pixels, as the decoder does not check it."""
    runs: list[int] = []
    at = 0
    while at < len(data):
        value, shift, more = 0, 0, True
        while more:
            if at >= len(data) or not 0 <= data[at] - 48 < 64 or shift > 60:
                raise ValueError("damaged run lengths")
            part = data[at] - 48
            value |= (part & 31) << shift
            more, at, shift = bool(part & 32), at + 1, shift + 5
            if not more and part & 16:
                value -= 1 << shift
        runs.append(value + runs[-2] if len(runs) > 2 else value)
    if min(runs, default=0) < 0 or sum(runs) != pixels:
        raise ValueError(f"run lengths of {sum(runs)} pixels, expected {pixels}")


def identity_of(values: Mapping[str, Any], keys: Iterable[str]) -> Hashable:
    """Return the first of the keys' values that identifies something: text or a whole number, or None."""
    for key in keys:
        value = values.get(key)
        if isinstance(value, str | int) and not isinstance(value, bool) and value != "":
            return value
    return None


def checked_size(width: Any, height: Any, where: str) -> tuple[int, int]:
    """Return a size (width, height); raise InputError if it is not one."""
    for side in (width, height):
        if not isinstance(side, int) or isinstance(side, bool) or not 0 < side <= LARGEST_SIDE:
            raise InputError(f"{where} has the size {width!r} x {height!r}; expected the photo's width and height.")
    return width, height
