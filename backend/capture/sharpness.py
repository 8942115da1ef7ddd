"""Which views of a capture are blurred, from the contrast of details that other views show as well."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter

from ..shared.stopping import Check, proceed
from .capture import Capture

BLURRED = 0.5
"""Contrast of a view's details, relative to that in other views, below which it is blurred: training is better without
such views, but becomes worse where softer ones are left out of a small capture."""

_POINTS = 1000
"""Largest number of points of a view at which its details are compared."""

_FEWEST_POINTS, _FEWEST_VIEWS = 20, 3
"""Number of points from which on a view is compared, and of views from which on a point is."""

_FINEST, _WINDOW = 0.8, 9
"""Standard deviation of the filter against noise, and side of the square around a point, in pixels."""

_NOISE = 5
"""Percentile of the energy in a view that is taken to be noise."""

_DARKEST = 4.0
"""Brightness of 255 that is added where the energy is divided by it, since black is noisy."""

_ROUNDS = 6
"""Number of alternating medians over views and points."""


def measure_contrasts(capture: Capture, views: Sequence[int], check: Check = proceed) -> np.ndarray:
    """Return the contrast of each view's fine details relative to those of the other views.

    A point looks alike in all views, so the energy of the image's derivatives around it is modeled as a product of
    three factors: one of the point, one of the view, and a power of the size at which the view shows the point. It is
    compared in four directions, and the least counts, since motion blurs in one direction.

    Args:
        capture: The capture; must be prepared.
        views: Indices of the views to compare.
        check: Called at intervals; ends the work by an exception once the user wants to stop.

    Returns:
        (len(views),) float64, ratios of gradients, 1 for the median view; 1 where too few points can be compared.

    Raises:
        InputError: An image cannot be read.
    """
    if not len(views):
        return np.ones(0)
    owner, point, size, energy = _observe(capture, views, check)
    seen_in = np.bincount(point, minlength=len(capture.points.xyz))
    compared = seen_in[point] >= _FEWEST_VIEWS
    owner, size, energy = owner[compared], size[compared], energy[compared]
    point = np.unique(point[compared], return_inverse=True)[1]
    counts = np.bincount(owner, minlength=len(views))
    if not len(owner):
        return np.ones(len(views))
    factors = np.stack([_factors_of_views(owner, point, size, each, len(views)) for each in energy.T])
    return np.where(counts >= _FEWEST_POINTS, np.exp(factors.min(0) / 2), 1.0)


def _observe(
    capture: Capture, views: Sequence[int], check: Check
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return where views show points: place in `views`, point, log size, and log energy in four directions (n, 4)."""
    xyz = capture.points.xyz
    # The same points in all views: those that come first in one order of all.
    order = np.random.default_rng(0).permutation(len(xyz))
    found = []
    for place, index in enumerate(views):
        check()
        view = capture.views[index]
        observed = np.unique(capture.observed(index))
        observed = observed[np.argsort(order[observed])]
        local = view.to_camera(xyz[observed])
        inside, x, y = (each[:_POINTS] for each in view.pixels_of(local))
        energies = _energies(capture.image(index))[y, x] if len(inside) else np.zeros((0, 4))
        size = np.log(view.K[0, 0] / local[inside, 2])
        found.append((np.full(len(inside), place), observed[inside], size, energies))
    owner, point, size, energy = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return owner, point, size, energy


def _energies(image: np.ndarray) -> np.ndarray:
    """Return the log energy (H, W, 4) of derivatives along x, y and the diagonals, relative to brightness."""
    gray = gaussian_filter(image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32), _FINEST)
    across, down = np.gradient(gray, axis=1), np.gradient(gray, axis=0)
    brightness = uniform_filter(gray, _WINDOW) + _DARKEST
    found = []
    for derivative in (across, down, (across + down) / 2**0.5, (across - down) / 2**0.5):
        energy = uniform_filter(derivative**2, _WINDOW) / brightness**2
        found.append(np.log(np.maximum(energy - np.percentile(energy, _NOISE), 1e-7)))
    return np.stack(found, -1)


def _factors_of_views(
    owner: np.ndarray, point: np.ndarray, size: np.ndarray, energy: np.ndarray, views: int
) -> np.ndarray:
    """Return the logarithm of each view's factor of the energy, 0 for the median view: (views,)."""
    points = int(point.max()) + 1
    seen = np.bincount(point, minlength=points)
    of_size = size - (np.bincount(point, size, points) / seen)[point]
    of_energy = energy - (np.bincount(point, energy, points) / seen)[point]
    power = (of_size * of_energy).sum() / max(float((of_size**2).sum()), 1e-9)
    left, factors = energy - power * size, np.zeros(views)
    for _ in range(_ROUNDS):
        of_points = _medians(left - factors[owner], point, points)
        factors = _medians(left - of_points[point], owner, views)
        factors -= np.median(factors)
    return factors


def _medians(values: np.ndarray, group: np.ndarray, groups: int) -> np.ndarray:
    """Return the median of the values in each group, 0 for empty ones: (groups,)."""
    ordered = values[np.lexsort((values, group))]
    counts = np.bincount(group, minlength=groups)
    first = np.cumsum(counts) - counts
    middle = np.minimum(first + np.stack([(counts - 1) // 2, counts // 2]), len(values) - 1)
    return np.where(counts > 0, ordered[middle].mean(0), 0.0)
