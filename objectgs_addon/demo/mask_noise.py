# SPDX-License-Identifier: GPL-3.0-or-later
"""Mistakes of a segmentation network, made on true ID maps.  No bpy here."""

from __future__ import annotations

from typing import Any

import numpy as np


def _smooth(shape: Any, cell: int, rng: Any) -> np.ndarray:
    """Random field in about -1..1 that varies over `cell` pixels."""
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
    """Copy of an ID map (H, W) with mistakes; `amount` from 0 (none) to 1 (poor).

    All borders wander by up to 4 * amount pixels in smooth waves.  Then each object of the view, by chance and apart
    from the others: with probability amount it is 1 to 3 pixels too large or too small (what it leaves is 0,
    unlabeled); with probability 0.15 * amount it carries another object's ID; with 0.10 * amount it is missing (0).
    These two happen only to what covers less than a fifth of the picture: networks seldom lose a wall.
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
