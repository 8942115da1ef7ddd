"""Estimation of the gain of each image, for cameras with automatic exposure and white balance.

COLMAP's points are observed in several images. In each channel, image i shows point p with the color gain_i * color_p.
The logarithms of all gains and colors are found at once, by least squares: a round of gains from colors and colors from
gains would pass a difference on to the next few photos of a path alone. Observations that disagree, as where something
hides a point, weigh less in each further round. In training, the splats are compared with images at a common exposure.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.linalg import LinearOperator, cg

from ...shared.stopping import Check, proceed

if TYPE_CHECKING:
    from ...capture import Capture

VARIES_FROM = 0.02
"""Standard deviation of the log gains above which the exposure is considered to vary."""

_MOST_OBSERVATIONS = 1_000_000
"""Number of observations, above which only every other point is used, or fewer."""

_ROUNDS = 8
_MIN_OBSERVATIONS = 30
"""Fewest observations of a view, of points that other views observe, too, for a gain of its own."""
_KEPT = 2 * _MIN_OBSERVATIONS
"""Observations that a view keeps where there are too many in all."""
_LIMIT = 4.0
"""Largest gain, and inverse of the smallest, relative to the median."""
_DARKEST = 2 / 255
"""Darker colors count as this."""
_DISAGREES = 0.1
"""Difference from the logarithm of a point's color at which an observation weighs half as much."""
_PULL = 1e-3
"""Weight that draws log gains toward 0, for views of which no point connects them with others."""


def measure_gains(capture: Capture, check: Check = proceed) -> np.ndarray:
    """Estimate the gains of all views from the training views alone.

    The gains of held-out views are unknown: nothing of them is used, and the names of photos say nothing of their
    exposure. `evaluation.metrics.color_corrected` measures renders of such views without it.

    Args:
        capture: A prepared capture with V views, whose points COLMAP observed.
        check: Called at intervals; ends the work by an exception once the user wants to stop.

    Returns:
        (V, 3) float64 in display space, with a geometric mean of 1 over the training views; 1 for held-out views, and
        for views with too few points.

    Raises:
        InputError: an image cannot be read.
    """
    gains = np.ones((len(capture.views), 3))
    observed: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    used = _used_points(capture)
    for i in capture.train_indices:
        check()
        observed[i] = _observations(capture, i, used)
    if not observed:
        return gains
    points, colors = (np.concatenate(found) for found in zip(*observed.values(), strict=True))
    views = np.repeat(list(observed), [len(found) for found, _ in observed.values()])
    kept = np.zeros(len(points), np.bool_)
    while not kept.all():
        # Views with too few observations are left out, which may leave out more points, and so on.
        kept = np.bincount(points)[points] > 1
        kept &= np.bincount(views[kept], minlength=len(gains))[views] >= _MIN_OBSERVATIONS
        points, colors, views = points[kept], colors[kept], views[kept]
    known = np.unique(views)
    if not len(known):
        return gains
    for channel in range(3):
        logs = np.log(np.maximum(colors[:, channel], _DARKEST))
        found = _log_gains(views, points, logs, len(gains), len(capture.points.xyz), check)[known]
        found = np.clip(found - np.median(found), -np.log(_LIMIT), np.log(_LIMIT))
        gains[known, channel] = np.exp(found - found.mean())
    return gains


def _log_gains(
    view: np.ndarray, point: np.ndarray, logs: np.ndarray, views: int, points: int, check: Check
) -> np.ndarray:
    """Return the log gains (views,) that explain the logarithms (n,) of a channel, each of a point in a view."""
    # Dark colors are inexact, relative to themselves.
    bright = np.exp(_of_groups(logs, point, np.ones(len(logs)), points))[point]
    weight, found = bright, np.zeros(views)
    for _ in range(_ROUNDS):
        check()
        # Least squares without the colors, which are the means of what the gains leave.
        each = csr_array((weight, (view, point)), (views, points))
        right = np.bincount(view, weight * (logs - _of_groups(logs, point, weight, points)[point]), views)
        found = cg(_without_colors(each), right, found, rtol=1e-6)[0]
        left = logs - found[view]
        left -= _of_groups(left, point, weight, points)[point]
        weight = bright / (1 + (left / _DISAGREES) ** 2)
    return found


def _without_colors(each: csr_array) -> LinearOperator:
    """Return the matrix (views, views) of the log gains' equations; each: (views, points), weights of observations.

    It is not computed, since it has an entry for each two views that show a point.
    """
    back, own, total = each.T.tocsr(), each.sum(1) + _PULL, np.maximum(each.sum(0), 1e-9)
    return LinearOperator((len(own),) * 2, lambda gains: own * gains - each @ ((back @ gains) / total), dtype=float)


def _of_groups(values: np.ndarray, group: np.ndarray, weight: np.ndarray, groups: int) -> np.ndarray:
    """Return the weighted mean (groups,) of the values (n,) in each group, 0 where there is none."""
    return np.bincount(group, weight * values, groups) / np.maximum(np.bincount(group, weight, groups), 1e-9)


def differences(gains: np.ndarray) -> float:
    """Return the largest standard deviation, over the channels, of the logarithms of the gains (V, 3).

    Views without a gain of their own, all 1, do not count.
    """
    own = gains[(gains != 1.0).any(1)]
    return float(np.log(own).std(0).max()) if len(own) else 0.0


def varies(gains: np.ndarray) -> bool:
    """Return whether the gains (V, 3) differ enough to be compensated."""
    return differences(gains) > VARIES_FROM


def _used_points(capture: Capture) -> np.ndarray:
    """Return which points (P,) bool are used: of too many, every other one or fewer, and enough of each view."""
    observed = [capture.keypoints(i).point_index for i in capture.train_indices]
    every, count = 1, sum(map(len, observed))
    while count > every * _MOST_OBSERVATIONS:
        every *= 2
    used = np.arange(len(capture.points.xyz)) % every == 0
    for points in observed:
        if np.count_nonzero(used[points]) < _KEPT:
            used[points[:: max(len(points) // _KEPT, 1)]] = True
    return used


def _observations(capture: Capture, index: int, used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points `used` (P,) in a view: indices (n,), colors (n, 3) in [0, 1], averaged over 3 x 3 pixels."""
    keypoints = capture.keypoints(index)
    pixels = capture.image(index)
    height, width = pixels.shape[:2]
    x, y = np.floor(keypoints.xy).astype(np.int64).T
    inside = (x >= 1) & (y >= 1) & (x < width - 1) & (y < height - 1) & used[keypoints.point_index]
    x, y = x[inside], y[inside]
    color = np.zeros((len(x), 3))
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            color += pixels[y + dy, x + dx]
    return keypoints.point_index[inside], color / (9 * 255)
