"""Estimation of the gain of each image, for cameras with automatic exposure and white balance.

COLMAP's points are observed in several images. In each channel, image i shows point p with the color gain_i * color_p;
gains and colors are estimated alternately, as medians and means. In training, the splats are compared with images at a
common exposure.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...shared.stopping import Check, proceed

if TYPE_CHECKING:
    from ...capture import Capture

VARIES_FROM = 0.02
"""Standard deviation of the log gains above which the exposure is considered to vary."""

_MOST_OBSERVATIONS = 5_000_000
"""Number of observations, each of which takes about 120 bytes, above which every other point is left out repeatedly."""

_ROUNDS = 10
_MIN_OBSERVATIONS = 30
_LIMIT = 4.0


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
    every, held = 1, 0
    for i in capture.train_indices:
        check()
        observed[i] = _observations(capture, i, every)
        held += len(observed[i][0])
        while held > _MOST_OBSERVATIONS:
            every *= 2
            observed = {view: _of_every(every, *found) for view, found in observed.items()}
            held = sum(len(points) for points, _ in observed.values())
    known = [i for i, (points, _) in observed.items() if len(points) >= _MIN_OBSERVATIONS]
    if len(known) < 2:
        return gains
    count = len(capture.points.xyz)
    # Those of all views at once, since each view observes only some of the points.
    all_points = np.concatenate([observed[i][0] for i in known])
    all_colors = np.concatenate([observed[i][1] for i in known])
    views = np.repeat(known, [len(observed[i][0]) for i in known])
    seen = np.bincount(all_points, minlength=count)
    for _ in range(_ROUNDS):
        check()
        compensated = all_colors / gains[views]
        total = [np.bincount(all_points, compensated[:, c], minlength=count) for c in range(3)]
        mean = np.stack(total, 1) / np.maximum(seen, 1)[:, None]
        for i in known:
            points, colors = observed[i]
            shared = seen[points] > 1
            model = mean[points[shared]]
            if shared.sum() >= _MIN_OBSERVATIONS and (model.sum(0) > 0).all():
                gains[i] = np.clip(_ratio(colors[shared], model), 1 / _LIMIT, _LIMIT)
        gains[known] /= np.exp(np.log(gains[known]).mean(0))
    return gains


def differences(gains: np.ndarray) -> float:
    """Return the largest standard deviation, over the channels, of the logarithms of the gains (V, 3).

    Views without a gain of their own, all 1, do not count.
    """
    own = gains[(gains != 1.0).any(1)]
    return float(np.log(own).std(0).max()) if len(own) else 0.0


def varies(gains: np.ndarray) -> bool:
    """Return whether the gains (V, 3) differ enough to be compensated."""
    return differences(gains) > VARIES_FROM


def _ratio(colors: np.ndarray, model: np.ndarray) -> np.ndarray:
    """Estimate the ratio (3,) of colors (n, 3) to the model's colors (n, 3).

    The median over the points, weighted by the model's color, is robust against points at edges or on shiny surfaces.
    """
    found = np.ones(3)
    for c in range(3):
        lit = model[:, c] > 0
        ratio, weight = colors[lit, c] / model[lit, c], model[lit, c]
        order = np.argsort(ratio)
        passed = np.cumsum(weight[order])
        found[c] = ratio[order][np.searchsorted(passed, 0.5 * passed[-1])]
    return found


def _of_every(every: int, points: np.ndarray, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (n,) and colors (n, 3) of the points whose index is a multiple of `every`."""
    kept = points % every == 0
    return points[kept], colors[kept]


def _observations(capture: Capture, index: int, every: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the points observed in a view: indices (n,), and colors (n, 3) in [0, 1], averaged over 3 x 3 pixels.

    Only those whose index is a multiple of `every`.
    """
    keypoints = capture.keypoints(index)
    pixels = capture.image(index)
    height, width = pixels.shape[:2]
    x, y = np.floor(keypoints.xy).astype(np.int64).T
    inside = (x >= 1) & (y >= 1) & (x < width - 1) & (y < height - 1) & (keypoints.point_index % every == 0)
    x, y = x[inside], y[inside]
    color = np.zeros((len(x), 3))
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            color += pixels[y + dy, x + dx]
    return keypoints.point_index[inside], color / (9 * 255)
