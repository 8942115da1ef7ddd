"""Detection of surroundings without points, such as the sky.

COLMAP finds no points there, and masks leave them unlabeled. Without splats of their own they are explained by splats
close to the cameras, which other views contradict, and which have the IDs of the objects in front. A direction belongs
to these surroundings if most views that contain it have no points and no object there. Points at a great distance
represent them; where the surroundings are in fact nearer, training moves the splats or adds others.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from ..capture import Capture
from ..shared.stopping import Check, proceed
from ..training.extent import SURROUNDINGS, extent_of
from .coverage import cells_of, examined_views, occupied_cells

SPACING = float(np.radians(2.0))
"""Angle between neighboring directions."""

LEAST = 0.02
"""Smallest fraction of the photos' pixels that shows surroundings without points, if there are any."""

_VACANT, _FEWEST = 0.5, 2
"""Smallest fraction of the views of a direction that have nothing there, and smallest number of them."""

_UNIFORM = 3.0
"""Largest standard deviation of the colors of uniform surroundings, of 255."""


class Surroundings(NamedTuple):
    """Surroundings without points.

    Attributes:
        xyz: (n, 3) float64, points in world units, all at the same distance from the center of the cameras.
        rgb: (n, 3) uint8, their colors.
        spacing: distance between neighboring points.
        fraction: fraction of the photos' pixels that shows them.
        uniform: whether they all have about the same color, so that a background of one color suffices.
    """

    xyz: np.ndarray
    rgb: np.ndarray
    spacing: float
    fraction: float
    uniform: bool


class _Directions(NamedTuple):
    """Directions (n, 3) from the cameras, and what views show there.

    Attributes:
        unit: (n, 3) all directions.
        vacant: (n,) int64, the number of views that show no points there.
        chosen: (n,) bool, those that belong to surroundings without points.
        shown: for each examined view its index, the directions (m,) where it shows no points, and their columns and
            rows (m,).
        fraction: fraction of the photos' pixels that shows the chosen ones.
    """

    unit: np.ndarray
    vacant: np.ndarray
    chosen: np.ndarray
    shown: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]]
    fraction: float


def find_surroundings(capture: Capture, more: np.ndarray, check: Check = proceed) -> Surroundings:
    """Find the directions in which the training views of a capture show surroundings without points.

    Args:
        capture: the capture; must be prepared.
        more: (n, 3) further points of surfaces, in world units.
        check: called at intervals; ends the work by an exception once the user wants to stop.

    Returns:
        The surroundings; xyz is empty if no direction shows any.

    Raises:
        InputError: an image or a mask cannot be read.
    """
    found = _directions(capture, more, check)
    total = np.zeros((len(found.unit), 3))
    for index, free, x, y in found.shown:
        check()
        of_chosen = found.chosen[free]
        if of_chosen.any():
            total[free[of_chosen]] += capture.image(index)[y[of_chosen], x[of_chosen]]
    extent = extent_of(capture)
    distance = SURROUNDINGS * extent.radius
    rgb = total[found.chosen] / found.vacant[found.chosen, None]
    return Surroundings(
        extent.center + distance * found.unit[found.chosen],
        rgb.round().astype(np.uint8),
        distance * SPACING,
        found.fraction,
        not len(rgb) or float(rgb.std(0).mean()) <= _UNIFORM,
    )


def measure_surroundings(capture: Capture, check: Check = proceed) -> float:
    """Return the fraction of the photos' pixels that shows surroundings without points of the capture.

    The arguments are those of `find_surroundings`; no image is read.
    """
    return _directions(capture, np.zeros((0, 3)), check).fraction


def _directions(capture: Capture, more: np.ndarray, check: Check) -> _Directions:
    """Return in which directions views show no points; the arguments are those of `find_surroundings`."""
    views, xyz = examined_views(capture), np.concatenate([capture.points.xyz, more])
    unit = _sphere(SPACING)
    inside, vacant = np.zeros(len(unit), np.int64), np.zeros(len(unit), np.int64)
    shown, sizes = [], []
    for index in views:
        check()
        view, free = capture.views[index], _vacant_cells(capture, index, xyz)
        local = unit @ view.viewmat[:3, :3].T
        seen, rows, columns = cells_of(view, local, free.shape)
        _, x, y = view.pixels_of(local)
        here = free[rows, columns]
        inside[seen] += 1
        vacant[seen[here]] += 1
        shown.append((index, seen[here], x[here], y[here]))
        sizes.append(len(seen))
    chosen = (vacant >= _FEWEST) & (vacant >= _VACANT * inside)
    fractions = [chosen[free].sum() / size for (_, free, _, _), size in zip(shown, sizes, strict=True) if size]
    return _Directions(unit, vacant, chosen, shown, float(np.mean(fractions)) if fractions else 0.0)


def _sphere(spacing: float) -> np.ndarray:
    """Return directions (n, 3) at about this angle from their neighbors (Fibonacci lattice)."""
    count = round(4 * np.pi / spacing**2)
    turns = np.arange(count) + 0.5
    z = 1 - 2 * turns / count
    angle = np.pi * (1 + np.sqrt(5)) * turns
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)


def _vacant_cells(capture: Capture, index: int, xyz: np.ndarray) -> np.ndarray:
    """Return the cells of a view without points (n, 3) in or beside them, and without objects: (rows, columns) bool."""
    view = capture.views[index]
    occupied = ndimage.binary_dilation(occupied_cells(view, xyz), np.ones((3, 3), np.bool_))
    rows, columns = occupied.shape
    mask = capture.mask(index)
    if mask is not None:
        y, x = np.nonzero(mask)
        occupied[y * rows // view.height, x * columns // view.width] = True
    return ~occupied
