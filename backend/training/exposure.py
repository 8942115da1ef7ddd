"""Measure the gain of each image, for cameras with automatic exposure and white balance.

COLMAP observes its points in many images. Image i shows point p as gain_i * color_p, channel by channel; gains and
colors are estimated alternately, as medians and means. Training then compares the splats with images of one common
exposure.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ..capture import Capture

VARIES_FROM = 0.02
"""The exposure varies if the standard deviation of the log gains exceeds this."""

_ROUNDS = 10
_MIN_OBSERVATIONS = 30
_LIMIT = 4.0


def measure_gains(capture: Capture) -> np.ndarray:
    """Measure the gains of all views from the training views alone.

    A held-out view's gain is interpolated between the training views of the same camera before and after it, in the
    order of their names.

    Returns:
        (V, 3) float64 in display space, with a geometric mean of 1 over the training views; 1 for views with too few
        points, or without such neighbors.

    Raises:
        InputError: an image cannot be read.
    """
    gains = np.ones((len(capture.views), 3))
    observed = {i: _observations(capture, i) for i in capture.train_indices}
    known = [i for i, (points, _) in observed.items() if len(points) >= _MIN_OBSERVATIONS]
    if len(known) < 2:
        return gains
    count = len(capture.points.xyz)
    for _ in range(_ROUNDS):
        total, seen = np.zeros((count, 3)), np.zeros(count)
        for i in known:
            points, colors = observed[i]
            for c in range(3):
                total[:, c] += np.bincount(points, colors[:, c] / gains[i, c], minlength=count)
            seen += np.bincount(points, minlength=count)
        mean = total / np.maximum(seen, 1)[:, None]
        for i in known:
            points, colors = observed[i]
            shared = seen[points] > 1
            model = mean[points[shared]]
            if shared.sum() >= _MIN_OBSERVATIONS and (model.sum(0) > 0).all():
                gains[i] = np.clip(_ratio(colors[shared], model), 1 / _LIMIT, _LIMIT)
        gains[known] /= np.exp(np.log(gains[known]).mean(0))
    for i in set(range(len(capture.views))) - set(known):
        camera = capture.views[i].camera_id
        same = [j for j in known if capture.views[j].camera_id == camera]
        if same:
            for c in range(3):
                gains[i, c] = np.exp(np.interp(i, same, np.log(gains[same, c])))
    return gains


def differences(gains: np.ndarray) -> float:
    """The largest standard deviation, over the channels, of the logarithms of the gains (V, 3)."""
    return float(np.log(gains).std(0).max())


def varies(gains: np.ndarray) -> bool:
    """Whether the gains (V, 3) differ by enough to be compensated."""
    return differences(gains) > VARIES_FROM


def _ratio(colors: np.ndarray, model: np.ndarray) -> np.ndarray:
    """The ratio (3,) of the colors (n, 3) to the model's (n, 3): the median over the points, weighted by the model's
    color, and so robust against points at edges or on shiny surfaces."""
    found = np.ones(3)
    for c in range(3):
        lit = model[:, c] > 0
        ratio, weight = colors[lit, c] / model[lit, c], model[lit, c]
        order = np.argsort(ratio)
        passed = np.cumsum(weight[order])
        found[c] = ratio[order][np.searchsorted(passed, 0.5 * passed[-1])]
    return found


def _observations(capture: Capture, index: int) -> tuple[np.ndarray, np.ndarray]:
    """The points observed in a view: their indices (n,) and colors (n, 3) in [0, 1], the mean of 3 x 3 pixels."""
    keypoints = capture.keypoints(index)
    pixels = capture.image(index)
    height, width = pixels.shape[:2]
    x, y = np.floor(keypoints.xy).astype(np.int64).T
    inside = (x >= 1) & (y >= 1) & (x < width - 1) & (y < height - 1)
    x, y = x[inside], y[inside]
    color = np.zeros((len(x), 3))
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            color += pixels[y + dy, x + dx]
    return keypoints.point_index[inside], color / (9 * 255)
