# SPDX-License-Identifier: GPL-3.0-or-later
"""Simulated segmentation errors, applied to ground-truth ID maps."""

from __future__ import annotations

from typing import Any

import numpy as np


def _smooth(shape: Any, cell: int, rng: Any) -> np.ndarray:
    """Return a smooth random field in about -1..1 that varies over `cell` pixels."""
    rows, cols = shape[0] // cell + 3, shape[1] // cell + 3
    coarse = rng.uniform(-1, 1, (rows, cols))
    y, x = np.arange(shape[0]) / cell, np.arange(shape[1]) / cell
    i, j = y.astype(int), x.astype(int)
    v, u = (y - i)[:, None], (x - j)[None]
    a, b = coarse[i][:, j], coarse[i][:, j + 1]
    c, d = coarse[i + 1][:, j], coarse[i + 1][:, j + 1]
    return (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)


def _grow(region: np.ndarray, pixels: int) -> np.ndarray:
    for _ in range(pixels):
        wide = region.copy()
        wide[1:] |= region[:-1]
        wide[:-1] |= region[1:]
        wide[:, 1:] |= region[:, :-1]
        wide[:, :-1] |= region[:, 1:]
        region = wide
    return region


def disturb(ids: np.ndarray, amount: float, rng: Any) -> np.ndarray:
    """Return a copy of an ID map with simulated segmentation errors.

    All borders are displaced smoothly by up to 4 * amount pixels. Then each object is changed independently: with
    probability amount, it grows or shrinks by 1 to 3 pixels (uncovered pixels become 0, unlabeled); with probability
    0.15 * amount, it gets the ID of a random object in the view; with probability 0.10 * amount, it is missing (0). The
    last two apply only to objects that cover at most a fifth of the image, since networks rarely miss a wall.

    Args:
        ids: (H, W) ID map.
        amount: from 0 (no errors) to 1 (poor masks).
        rng: random generator.
    """
    if amount <= 0:
        return ids.copy()
    height, width = ids.shape
    rows, cols = np.mgrid[:height, :width]
    rows = np.clip(np.round(rows + 4 * amount * _smooth(ids.shape, 12, rng)), 0, height - 1).astype(int)
    cols = np.clip(np.round(cols + 4 * amount * _smooth(ids.shape, 12, rng)), 0, width - 1).astype(int)
    bent = ids[rows, cols]
    result = bent.copy()
    present = np.unique(bent)
    for value in present[present > 0]:
        chance = rng.random(3)
        pixels = int(rng.integers(1, 4))
        other = int(rng.choice(present))
        region = bent == value
        if chance[0] < amount / 2:
            result[_grow(region, pixels)] = value
        elif chance[0] < amount:
            result[region & _grow(~region, pixels)] = 0
        if region.mean() > 0.2:
            continue
        if chance[1] < 0.15 * amount:
            result[region] = other
        elif chance[2] < 0.10 * amount:
            result[region] = 0
    return result
