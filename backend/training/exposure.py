"""How much brighter or bluer each photo is than the others: cameras that set their own exposure and white balance.

COLMAP's points are seen in many photos. Photo i shows point p as gain_i * color_p, channel by channel; gains and
colours are found in turns, as medians and means. Training then compares the splats with photos of one common exposure.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ..capture import Capture

VARIES_FROM = 0.02
"""Standard deviation of the log gains from which on exposure is said to vary."""

_ROUNDS = 10
_MIN_OBSERVATIONS = 30
_LIMIT = 4.0


def measure_gains(capture: Capture) -> np.ndarray:
    """(V, 3) float64 gains in display space, geometric mean 1 over the training views, from those views alone.

    A held-out view's gain is read off its neighbours: between the training views before and after it of the same
    camera, in the order of their names. Views with too few points, or without such neighbours, have gain 1.
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
    """By how much the gains (V, 3) differ: standard deviation of their logarithms, of the channel where it is most."""
    return float(np.log(gains).std(0).max())


def varies(gains: np.ndarray) -> bool:
    """Whether the gains (V, 3) differ by enough to be worth undoing."""
    return differences(gains) > VARIES_FROM


def _ratio(colors: np.ndarray, model: np.ndarray) -> np.ndarray:
    """By how much the colours (n, 3) exceed the model's (n, 3): (3,), the median over the points, weighted by the
    model, so that points at the edge of something, or that shine, do not count by how far off they are."""
    found = np.ones(3)
    for c in range(3):
        lit = model[:, c] > 0
        ratio, weight = colors[lit, c] / model[lit, c], model[lit, c]
        order = np.argsort(ratio)
        passed = np.cumsum(weight[order])
        found[c] = ratio[order][np.searchsorted(passed, 0.5 * passed[-1])]
    return found


def _observations(capture: Capture, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Point index (n,) and colour (n, 3) in [0, 1], the mean of 3 x 3 pixels, of the points observed in a view."""
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
