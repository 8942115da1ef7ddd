"""Random walker segmentation of a graph with several labels (Grady 2006, with the priors of Grady 2005).

A walker starts at a node and takes each edge with a probability proportional to its weight. The node gets the label of
the seeds that it most probably reaches first. The probabilities solve one sparse, symmetric and positive definite
system for each label, here all of them together, by conjugate gradients.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

ITERATIONS, TOLERANCE = 150, 1e-4
"""The solution ends after this number of iterations, or when every residual is this fraction of its right-hand side."""


def random_walker(
    weights: sparse.csr_array, seeds: np.ndarray, labels: int, prior: np.ndarray, strength: float
) -> np.ndarray:
    """Find the probability of each label at each node.

    Args:
        weights: (N, N) symmetric weights of the edges, >= 0.
        seeds: (N,) int64, the label 0 .. labels - 1 of each seed, -1 for other nodes.
        labels: number of labels.
        prior: (N, labels) how well each node fits each label, >= 0; its rows add up to at most 1.
        strength: weight of the prior, relative to the edges' weights.

    Returns:
        (N, labels) float64, which adds up to 1 where a seed or the prior is reached.
    """
    known, free = np.flatnonzero(seeds >= 0), np.flatnonzero(seeds < 0)
    found = np.zeros((len(seeds), labels))
    found[known, seeds[known]] = 1.0
    if not len(free):
        return found
    rows = weights[free]
    to_free = rows[:, free].tocsr()
    diagonal = np.asarray(rows.sum(axis=1)).ravel() + strength * prior[free].sum(1) + 1e-12
    right = rows @ found + strength * prior[free]
    preconditioner = 1.0 / diagonal[:, None]
    x = np.zeros_like(right)
    residual = right.copy()
    direction = preconditioner * residual
    product = (residual * direction).sum(0)
    stop = TOLERANCE**2 * np.maximum((right * right).sum(0), 1e-300)
    for _ in range(ITERATIONS):
        image = diagonal[:, None] * direction - to_free @ direction
        step = product / np.maximum((direction * image).sum(0), 1e-300)
        x += step * direction
        residual -= step * image
        if ((residual * residual).sum(0) <= stop).all():
            break
        scaled = preconditioner * residual
        following = (residual * scaled).sum(0)
        direction = scaled + direction * (following / np.maximum(product, 1e-300))
        product = following
    found[free] = x
    return found
