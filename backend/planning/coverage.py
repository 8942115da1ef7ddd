"""Which views add nothing, and which points no view shows."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..capture import Capture

SAME_PIXELS = 0.5
"""Two views stand at one place where the points that one sees move by no more than this in the other, in pixels."""

SAME_COLOUR = 1.5
"""Their pictures are the same where they differ by no more than this on average, of 255: as after one JPEG more."""

MARGIN = 0.1
"""Splats reach beyond their points, so a view is taken for so much wider and higher, on each side."""


def duplicate_views(capture: Capture) -> list[int]:
    """The training views, ascending, that show the same picture from the same place as an earlier training view.

    Their masks must show the same objects, too. Photos are only read where the places agree.
    """
    train = list(capture.train_indices)
    if len(train) < 2:
        return []
    places = _places(capture, train)
    found: set[int] = set()
    # Pairs by the earlier view, so that of three that are the same the first stays.
    for first, second in sorted(cKDTree(places).query_pairs(SAME_PIXELS, p=np.inf)):
        a, b = train[first], train[second]
        if a not in found and b not in found and _same_camera(capture, a, b) and _same_picture(capture, a, b):
            found.add(b)
    return sorted(found)


def _places(capture: Capture, views: list[int]) -> np.ndarray:
    """Where views stand and how they are turned, (n, 12): a step of 1 moves what one of them sees by a pixel or less,
    in the view whose points are nearest by about a pixel."""
    rotations = np.array([capture.views[i].viewmat[:3, :3] for i in views])
    shifts = np.array([capture.views[i].viewmat[:3, 3] for i in views])
    focals = np.array([capture.views[i].K[0, 0] for i in views])
    pixels_a_length = 0.0
    for index, rotation, shift, focal in zip(views, rotations, shifts, focals, strict=True):
        depths = capture.points.xyz[capture.observed(index)] @ rotation[2] + shift[2]
        depth = float(np.median(depths)) if len(depths) else 0.0
        if depth > 0:
            pixels_a_length = max(pixels_a_length, focal / depth)
    centres = -np.einsum("nji,nj->ni", rotations, shifts)
    return np.concatenate(
        [(centres - centres.mean(0)) * pixels_a_length, rotations.reshape(-1, 9) * focals.max()], axis=1
    )


def _same_camera(capture: Capture, a: int, b: int) -> bool:
    first, second = capture.views[a], capture.views[b]
    same_size = (first.width, first.height) == (second.width, second.height)
    return same_size and np.allclose(first.K, second.K, rtol=0, atol=SAME_PIXELS)


def _same_picture(capture: Capture, a: int, b: int) -> bool:
    if capture.ids_in(a) != capture.ids_in(b):
        return False
    difference = capture.image(a).astype(np.int16) - capture.image(b)
    return float(np.abs(difference).mean()) <= SAME_COLOUR


def blind_views(capture: Capture) -> list[int]:
    """The training views that no point lies in, nor near their border; none where that is true of all."""
    views = capture.train_indices
    blind = [i for i in views if not len(capture.observed(i)) and not _inside(capture, i, capture.points.xyz).any()]
    return blind if len(blind) < len(views) else []


def views_without(capture: Capture) -> list[int]:
    """The training views whose masks show none of the objects that are not left out."""
    views = capture.train_indices
    without = [i for i in views if capture.views[i].mask_file is not None and not set(capture.ids_in(i)) - {0}]
    return without if len(without) < len(views) else []


def unseen_points(capture: Capture) -> np.ndarray:
    """(M,) bool: the points that lie outside of every training view; none where that is true of all.

    What COLMAP observed in a training view needs no looking for, so that only few points are.
    """
    unseen = np.ones(len(capture.points.xyz), np.bool_)
    for index in capture.train_indices:
        unseen[capture.observed(index)] = False
    for index in capture.train_indices:
        left = np.flatnonzero(unseen)
        if not len(left):
            break
        unseen[left[_inside(capture, index, capture.points.xyz[left])]] = False
    return unseen if not unseen.all() else np.zeros_like(unseen)


def _inside(capture: Capture, index: int, xyz: np.ndarray) -> np.ndarray:
    """Which of the points xyz (n, 3) lie in a view's picture or near its border: (n,) bool."""
    view = capture.views[index]
    x, y, z = (xyz @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]).T
    across, down = MARGIN * view.width, MARGIN * view.height
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        u = x / z * view.K[0, 0] + view.K[0, 2]
        v = y / z * view.K[1, 1] + view.K[1, 2]
        inside = (u >= -across) & (u <= view.width + across) & (v >= -down) & (v <= view.height + down)
    return (z > 0) & inside
