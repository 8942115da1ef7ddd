"""Masks whose borders follow the edges of the photo.

Splats are coarser than pixels and reach across the borders of objects. Near a border, the pixels therefore get their
objects from a random walker, whose prior is what the splats show.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage, sparse
from skimage.color import rgb2lab

from .random_walker import random_walker

BAND = 2
"""Distance in pixels, along rows and columns, from a rendered border within which it is placed anew."""

STEP, PRIOR = 6.0, 0.3
"""CIELAB distance of neighboring pixels that hardly separates them, and weight of what the splats show."""

_LEAST = 1e-4
_NEIGHBORS = ((0, 1), (1, 0), (1, 1), (1, -1))


def follow_edges(photo: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Place the borders of objects at edges of the photo.

    Args:
        photo: (H, W, 3) uint8.
        shown: (H, W, C) float32, how much of each pixel shows each of C objects.

    Returns:
        (H, W) int64, the object of each pixel, from 0 to C - 1.
    """
    labels = shown.argmax(2)
    is_border = ndimage.maximum_filter(labels, 3) != ndimage.minimum_filter(labels, 3)
    if not is_border.any():
        return labels
    band = ndimage.maximum_filter(is_border, 2 * BAND + 1)
    nodes = ndimage.binary_dilation(band)
    number = np.full(labels.shape, -1)
    number[nodes] = np.arange(nodes.sum())
    lab = rgb2lab(photo[nodes][None])[0]
    height, width = labels.shape
    weights = sparse.csr_array((int(nodes.sum()),) * 2)
    for down, right in _NEIGHBORS:
        here = slice(0, height - down), slice(max(0, -right), width - max(0, right))
        there = slice(down, height), slice(max(0, right), width - max(0, -right))
        both = (number[here] >= 0) & (number[there] >= 0)
        ends = number[here][both], number[there][both]
        step = np.linalg.norm(lab[ends[0]] - lab[ends[1]], axis=1)
        weight = _LEAST + np.exp(-((step / STEP) ** 2)) / np.hypot(down, right)
        weights += sparse.coo_array((weight, ends), shape=weights.shape).tocsr()
    seeds = np.where(band[nodes], -1, labels[nodes])
    prior = shown[nodes].astype(np.float64)
    prior /= np.maximum(prior.sum(1, keepdims=True), 1e-6)
    found = random_walker((weights + weights.T).tocsr(), seeds, prior, PRIOR, start=prior)
    labels[nodes] = found.argmax(1)
    return labels
