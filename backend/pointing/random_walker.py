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
from .clusters import FEW, Clusters, no_clusters

ITERATIONS, ITERATIONS_AGAIN, TOLERANCE = 300, 100, 1e-3
"""The solution ends after the first number of iterations, or after the second if it begins with an earlier one, or when
every residual is the third number relative to its right-hand side."""

LEAST = 1e-6
"""Added to what is outside of a cluster, relative to all edges of its nodes."""

_PARTS = 64
"""Number of parts of the nodes whose sums are added in order, so that results do not depend on the threads."""


@kernel(parallel=True)
def _solve(starts, neighbors, weights, diagonal, right, free, x, iterations, tolerance, tree, scale, inverse):
    """Solve (diagonal - weights) x = right for the free rows in place, beginning with x; x is 0 in the others.

    The rows of right and x are those of one block of `simd.LANES` labels; all arrays but the inverse have one
    dimension. tree: clusters of the rows; scale and inverse: as from `_coarse`.
    """
    levels, parent, firsts, members = tree
    n, lanes = len(diagonal), simd.LANES
    clusters, lowest = levels[-1] - n, levels[2] - n if len(levels) > 2 else 0
    # Of the rows and their clusters: the sum of the residuals, and the correction.
    residual, direction = np.zeros((n + clusters) * lanes, np.float32), np.zeros(n * lanes, np.float32)
    correction = np.zeros((n + clusters) * lanes, np.float32)
    image = np.zeros(n * lanes, np.float32)
    sums = np.zeros((3, _PARTS * lanes), np.float32)
    for part in prange(_PARTS):
        size = simd.splat(np.float32(0))
        for i in range(part * n // _PARTS, (part + 1) * n // _PARTS):
            if free[i]:
                row = i * lanes
                wanted = simd.load(right, row)
                left = wanted - simd.splat(diagonal[i]) * simd.load(x, row)
                for e in range(starts[i], starts[i + 1]):
                    left = left + simd.splat(weights[e]) * simd.load(x, neighbors[e] * lanes)
                simd.store(residual, row, left)
                size = size + wanted * wanted
        simd.store(sums[0], part * lanes, size)
    stop = np.maximum(tolerance * tolerance * _added(sums[0]), 1e-30)
    product = np.full(lanes, np.inf)
    step = np.zeros(lanes, np.float32)
    for iteration in range(iterations + 1):
        for part in prange(_PARTS):
            forward, scaled, size = simd.load(step, 0), simd.splat(np.float32(0)), simd.splat(np.float32(0))
            for i in range(part * n // _PARTS, (part + 1) * n // _PARTS):
                if free[i]:
                    row = i * lanes
                    left = simd.load(residual, row) - forward * simd.load(image, row)
                    simd.store(residual, row, left)
                    simd.store(x, row, simd.load(x, row) + forward * simd.load(direction, row))
                    scaled = scaled + simd.splat(scale[i]) * left * left
                    size = size + left * left
            simd.store(sums[1], part * lanes, scaled)
            simd.store(sums[2], part * lanes, size)
        if iteration == iterations or (_added(sums[2]) <= stop).all():
            break
        for part in prange(_PARTS):
            for c in range(part * lowest // _PARTS, (part + 1) * lowest // _PARTS):
                total = simd.splat(np.float32(0))
                for m in range(firsts[c], firsts[c + 1]):
                    total = total + simd.load(residual, members[m] * lanes)
                simd.store(residual, (n + c) * lanes, total)
        following = _added(sums[1])
        if clusters:
            following += _correct(tree, scale, inverse, residual, correction)
        turn = (following / np.maximum(product, 1e-30)).astype(np.float32)
        product = following
        for part in prange(_PARTS):
            back = simd.load(turn, 0)
            for i in range(part * n // _PARTS, (part + 1) * n // _PARTS):
                if free[i]:
                    row = i * lanes
                    here = simd.splat(scale[i]) * simd.load(residual, row) + back * simd.load(direction, row)
                    if clusters:
                        here = here + simd.load(correction, parent[i] * lanes)
                    simd.store(direction, row, here)
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


@kernel()
def _correct(tree, scale, inverse, residual, correction):
    """Fill the corrections of clusters by their residuals, of which the lowest level is given, from the top down.

    Return the products (simd.LANES,) of residuals and corrections, where that of a level counts by itself.
    """
    levels, parent, firsts, members = tree
    n, first, lanes = levels[1], levels[-2], simd.LANES
    for c in range(levels[2], levels[-1]):
        total = simd.splat(np.float32(0))
        for m in range(firsts[c - n], firsts[c - n + 1]):
            total = total + simd.load(residual, members[m] * lanes)
        simd.store(residual, c * lanes, total)
    parts = np.zeros(lanes, np.float32)
    products = np.zeros(lanes)
    below = levels[-1]
    if len(inverse):
        below = first
        for c in range(len(inverse)):
            total = simd.splat(np.float32(0))
            for other in range(len(inverse)):
                total = total + simd.splat(inverse[c, other]) * simd.load(residual, (below + other) * lanes)
            row = (below + c) * lanes
            simd.store(correction, row, total)
            simd.store(parts, 0, total * simd.load(residual, row))
            products += parts
    for c in range(below - 1, n - 1, -1):
        row = c * lanes
        left = simd.load(residual, row)
        own = simd.splat(scale[c]) * left
        simd.store(parts, 0, own * left)
        products += parts
        if c < first:
            own = own + simd.load(correction, parent[c] * lanes)
        simd.store(correction, row, own)
    return products


@kernel()
def _coarse(starts, neighbors, weights, diagonal, free, tree):
    """Return what corrects the free rows of (diagonal - weights) x = right, and their clusters.

    Returns:
        The inverse diagonal of each row and cluster, and the matrix of the top level's clusters, (0, 0) where these are
        no clusters or too many.
    """
    levels, parent = tree[0], tree[1]
    n, count, first = levels[1], levels[-1], levels[-2]
    total, within = np.zeros(count), np.zeros(count)
    few = count - first if first > 0 and count - first <= FEW else 0
    matrix = np.zeros((few, few))
    for i in range(n):
        if free[i]:
            total[i] = diagonal[i]
            for e in range(starts[i], starts[i + 1]):
                j = neighbors[e]
                if free[j]:
                    a, b = np.int64(i), np.int64(j)
                    while a != b and a < first:
                        a, b = parent[a], parent[b]
                    if a == b:
                        within[a] += weights[e]
                    elif few:
                        matrix[a - first, b - first] -= weights[e]
    for i in range(first):
        total[parent[i]] += total[i]
        within[parent[i]] += within[i]
    for i in range(few):
        outside = total[first + i] - within[first + i] + LEAST * total[first + i]
        matrix[i, i] += outside if total[first + i] > 0 else 1.0
    scale = 1 / np.maximum(np.maximum(total - within, LEAST * total), 1e-30)
    return np.where(total > 0, scale, 0).astype(np.float32), matrix


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
    clusters: Clusters | None = None,
) -> np.ndarray:
    """Find the probability of each label at each node.

    Args:
        weights: (N, N) symmetric weights of the edges, >= 0.
        seeds: (N,) the label 0 .. labels - 1 of each seed, -1 for other nodes.
        prior: (N, labels) how well each node fits each label, >= 0.
        strength: weight of the prior, relative to the edges' weights.
        start: (N, labels) an earlier result for similar seeds, from which the solution begins; None: none.
        clusters: clusters of the nodes, which make the solution faster.

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
    graph = weights.indptr, weights.indices, weights.data.astype(np.float32), diagonal.astype(np.float32)
    tree = no_clusters(count) if clusters is None else clusters
    scale, matrix = _coarse(*graph, free, tree)
    inverse = np.linalg.inv(matrix).astype(np.float32)
    for first in range(0, labels, simd.LANES):
        block = slice(first, min(first + simd.LANES, labels))
        x, wanted = np.zeros((count, simd.LANES), np.float32), np.zeros((count, simd.LANES), np.float32)
        wanted[:, : block.stop - first] = right[:, block]
        x[:, : block.stop - first] = np.where(free[:, None], found[:, block], 0.0)
        _solve(
            *graph, wanted.ravel(), free, x.ravel(), ITERATIONS if start is None else ITERATIONS_AGAIN, TOLERANCE,
            tree, scale, inverse,
        )  # fmt: skip
        found[:, block] = np.where(free[:, None], x[:, : block.stop - first], known[:, block])
    return found
