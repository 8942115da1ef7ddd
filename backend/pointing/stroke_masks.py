"""The pixels that a stroke stands for: all that a segmentation model shows by it, or those that it covers."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence

import numpy as np
from scipy import ndimage

from .strokes import Stroke

Segment = Callable[[Hashable, Callable[[], np.ndarray], np.ndarray, np.ndarray], np.ndarray]
"""Returns the mask (H, W) bool of what points mark in a picture.

Its arguments are a key that identifies the picture, a function that returns it as (H, W, 3) uint8, the points (n, 2) as
x and y in pixels, with the center of the first pixel at (0.5, 0.5), and their labels (n,): 1 on the object, 0 not.
"""

_POINTS, _POINTS_OF_OTHERS, _MOST_OF_OTHERS = 6, 2, 8
"""Number of points on a stroke, on each stroke of other objects, and on all of those together."""

_LEAST, _LARGEST = 0.7, 0.5
"""Least part of the stroke's pixels that a mask must contain, and largest part of the picture that it may cover."""

_ERODED = 1 / 320
"""Width of a mask's border that is left out, relative to the longer side: masks are a pixel wrong there, and splats at
outlines belong to both sides."""


def stroke_pixels(
    stroke: Stroke,
    others: Sequence[Stroke],
    size: tuple[int, int],
    segment: Segment | None,
    picture: Callable[[], np.ndarray],
) -> tuple[np.ndarray, bool]:
    """Return the pixels (H, W) bool that a stroke stands for, and whether they are the mask of a model.

    They are the mask that a model finds, without its border, if that contains most of the stroke, no stroke of another
    object, and less than half of the picture; otherwise, and for exact strokes, those that the stroke covers.

    Args:
        stroke: the stroke.
        others: strokes on other objects, or on none, that were drawn from the same viewpoint.
        size: width and height of the picture.
        segment: the model, if there is one.
        picture: returns the picture, (H, W, 3) uint8.
    """
    own = stroke.pixels(*size)
    if segment is None or stroke.exact:
        return own, False
    points = [points_on(stroke, size, _POINTS), *(points_on(other, size, _POINTS_OF_OTHERS) for other in others)]
    on_others = np.concatenate([np.zeros((0, 2)), *points[1:]])[-_MOST_OF_OTHERS:]
    labels = np.repeat([1, 0], [len(points[0]), len(on_others)])
    mask = segment(stroke.view, picture, np.concatenate([points[0], on_others]), labels)
    if mask[own].mean() < _LEAST or mask.mean() > _LARGEST:
        return own, False
    covered = [other.pixels(*size) for other in others]
    if any(mask[pixels].mean() >= 0.5 for pixels in covered):
        return own, False
    inside = ndimage.distance_transform_edt(np.pad(mask, 1, mode="edge"))[1:-1, 1:-1]
    border = max(1.0, _ERODED * max(size))
    # A thin object may consist of nothing but its border.
    core = inside > border if (inside > border).sum() > 0.5 * mask.sum() else mask
    return (core & ~np.any([*covered, np.zeros_like(own)], axis=0)) | (own & mask), True


def points_on(stroke: Stroke, size: tuple[int, int], most: int) -> np.ndarray:
    """Return up to `most` points (n, 2) on a stroke, or inside an area, in pixels of a picture of this size."""
    if stroke.area and len(stroke.points) > 2:
        return _points_inside(stroke.pixels(*size), most)
    corners = np.multiply(stroke.points, size)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    count = int(np.clip(np.ceil(along[-1] / (0.02 * max(size))), 1, most))
    # Not the ends, which are most often beyond the object.
    at = along[-1] * (np.arange(count) + 0.5) / count
    return np.column_stack([np.interp(at, along, corners[:, axis]) for axis in (0, 1)])


def _points_inside(area: np.ndarray, most: int) -> np.ndarray:
    """Return up to `most` points (n, 2) in pixels, spread over the inner half of an area (H, W) bool."""
    depth = ndimage.distance_transform_edt(np.pad(area, 1))[1:-1, 1:-1]
    rows, columns = np.nonzero(depth >= 0.5 * depth.max())
    places = np.column_stack([columns, rows]) + 0.5
    chosen = [int(depth[rows, columns].argmax())]
    distance = np.linalg.norm(places - places[chosen[0]], axis=1)
    while len(chosen) < most and distance.max() > 1.0:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return places[chosen]
