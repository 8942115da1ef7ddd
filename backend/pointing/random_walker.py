"""Random walker segmentation of a graph with several labels (Grady 2006, with the priors of Grady 2005).

A walker starts at a node and takes each edge with a probability proportional to its weight. The node gets the label of
the seeds that it most probably reaches first. The probabilities solve one sparse, symmetric and positive definite
system for each label, here all of them together, by conjugate gradients.
"""

from __future__ import annotations

import numpy as np
from numba import prange
from scipy import sparse

from ..raster import simd
from ..raster.kernel import kernel

ITERATIONS, ITERATIONS_AGAIN, TOLERANCE = 300, 100, 1e-3
"""The solution ends after the first number of iterations, or after the second if it begins with an earlier one, or when
every residual is the third number relative to its right-hand side."""

_PARTS = 64
"""Number of parts of the nodes whose sums are added in order, so that results do not depend on the threads."""


@kernel(parallel=True)
def _solve(starts, neighbors, weights, diagonal, right, free, x, iterations, tolerance):
    """Solve (diagonal - weights) x = right for the free rows in place, beginning with x; x is 0 in the others.

    The rows of right and x are those of one block of `simd.LANES` labels; all arrays have one dimension.
    """
    n, lanes = len(diagonal), simd.LANES
    residual, direction = np.zeros(n * lanes, np.float32), np.zeros(n * lanes, np.float32)
    image = np.zeros(n * lanes, np.float32)
    sums = np.zeros((4, _PARTS * lanes), np.float32)
    for part in prange(_PARTS):
        size, product = simd.splat(np.float32(0)), simd.splat(np.float32(0))
        for i in range(part * n // _PARTS, (part + 1) * n // _PARTS):
            if free[i]:
                row = i * lanes
                wanted = simd.load(right, row)
                left = wanted - simd.splat(diagonal[i]) * simd.load(x, row)
                for e in range(starts[i], starts[i + 1]):
                    left = left + simd.splat(weights[e]) * simd.load(x, neighbors[e] * lanes)
                scaled = simd.splat(np.float32(1) / diagonal[i]) * left
                simd.store(residual, row, left)
                simd.store(direction, row, scaled)
                size = size + wanted * wanted
                product = product + left * scaled
        simd.store(sums[0], part * lanes, size)
        simd.store(sums[1], part * lanes, product)
    stop = np.maximum(tolerance * tolerance * _added(sums[0]), 1e-30)
    product = _added(sums[1])
    for _ in range(iterations):
        for part in prange(_PARTS):
            along = simd.splat(np.float32(0))
            for i in range(part * n // _PARTS, (part + 1) * n // _PARTS):
                if free[i]:
                    row = i * lanes
                    here = simd.load(direction, row)
                    there = simd.splat(diagonal[i]) * here
                    for e in range(starts[i], starts[i + 1]):
                        there = there - simd.splat(weights[e]) * simd.load(direction, neighbors[e] * lanes)
                    simd.store(image, row, there)
                    along = along + here * there
            simd.store(sums[0], part * lanes, along)
        step = (product / np.maximum(_added(sums[0]), 1e-30)).astype(np.float32)
        for part in prange(_PARTS):
            forward, scaled, size = simd.load(step, 0), simd.splat(np.float32(0)), simd.splat(np.float32(0))
            for i in range(part * n // _PARTS, (part + 1) * n // _PARTS):
                if free[i]:
                    row = i * lanes
                    left = simd.load(residual, row) - forward * simd.load(image, row)
                    simd.store(residual, row, left)
                    simd.store(x, row, simd.load(x, row) + forward * simd.load(direction, row))
                    scaled = scaled + simd.splat(np.float32(1) / diagonal[i]) * left * left
                    size = size + left * left
            simd.store(sums[1], part * lanes, scaled)
            simd.store(sums[2], part * lanes, size)
        following = _added(sums[1])
        if (_added(sums[2]) <= stop).all():
            break
        turn = (following / np.maximum(product, 1e-30)).astype(np.float32)
        product = following
        for part in prange(_PARTS):
            back = simd.load(turn, 0)
            for i in range(part * n // _PARTS, (part + 1) * n // _PARTS):
                if free[i]:
                    row, scale = i * lanes, simd.splat(np.float32(1) / diagonal[i])
                    simd.store(direction, row, scale * simd.load(residual, row) + back * simd.load(direction, row))


@kernel()
def _added(parts):
    """Return the sums (simd.LANES,) float64 of the parts."""
    total = np.zeros(simd.LANES)
    for i in range(len(parts)):
        total[i % simd.LANES] += parts[i]
    return total


def random_walker(
    weights: sparse.csr_array,
    seeds: np.ndarray,
    prior: np.ndarray,
    strength: float,
    start: np.ndarray | None = None,
) -> np.ndarray:
    """Find the probability of each label at each node.

    Args:
        weights: (N, N) symmetric weights of the edges, >= 0.
        seeds: (N,) the label 0 .. labels - 1 of each seed, -1 for other nodes.
        prior: (N, labels) how well each node fits each label, >= 0.
        strength: weight of the prior, relative to the edges' weights.
        start: (N, labels) an earlier result for similar seeds, from which the solution begins; None: none.

    Returns:
        (N, labels) float32, which adds up to 1 where a seed or the prior is reached.
    """
    count, labels = prior.shape
    free = seeds < 0
    known = np.zeros((count, labels), np.float32)
    known[~free, seeds[~free]] = 1.0
    diagonal = np.asarray(weights.sum(axis=1)).ravel() + strength * prior.sum(1) + 1e-12
    right = weights @ known + strength * prior
    found = known.copy() if start is None else np.where(free[:, None], start, known)
    for first in range(0, labels, simd.LANES):
        block = slice(first, min(first + simd.LANES, labels))
        x, wanted = np.zeros((count, simd.LANES), np.float32), np.zeros((count, simd.LANES), np.float32)
        wanted[:, : block.stop - first] = right[:, block]
        x[:, : block.stop - first] = np.where(free[:, None], found[:, block], 0.0)
        _solve(
            weights.indptr, weights.indices, weights.data.astype(np.float32), diagonal.astype(np.float32),
            wanted.ravel(), free, x.ravel(), ITERATIONS if start is None else ITERATIONS_AGAIN, TOLERANCE,
        )  # fmt: skip
        found[:, block] = np.where(free[:, None], x[:, : block.stop - first], known[:, block])
    return found
