"""Random walker segmentation of a graph with several labels (Grady 2006, with the priors of Grady 2005).

A walker starts at a node and takes each edge with a probability proportional to its weight. The node gets the label of
the seeds that it most probably reaches first. The probabilities solve one sparse, symmetric and positive definite
system for each label, here all of them together, by conjugate gradients. `best_borders` then chooses where labels end
that no other label stops.
"""

from __future__ import annotations

import numpy as np
from numba import prange
from scipy import sparse

from ..raster import simd
from ..raster.kernel import kernel
from .clusters import FEW, Clusters, Coarse, no_clusters

ITERATIONS, ITERATIONS_AGAIN, TOLERANCE = 300, 100, 1e-3
"""The solution ends after the first number of iterations, or after the second if it begins with an earlier one, or when
every residual is the third number relative to its right-hand side, in the norm of the corrections: a small residual of
what is hardly connected is a large error."""

THRESHOLDS, SIZE_POWER, ODDS_POWER = np.linspace(0.3, 0.97, 41), 0.7, 0.8
"""Probabilities of a label against none from which on it may have a node; the powers of the size of what it then has,
and of the odds of the threshold, so that none far from one half is taken without need."""

_ROUNDING = 1e-9
"""Weights that are smaller, relative to those of all edges, may be none."""

LEAST = 1e-6
"""Added to what is outside of a cluster, relative to all edges of its nodes."""

TINY = np.float32(1e-11)
"""Values that are much smaller are rounded to zero: products of these are denormal, for which processors take long."""

_PARTS = 64
"""Number of parts of the nodes whose sums are added in order, so that results do not depend on the threads."""


@kernel(parallel=True)
def _solve(starts, neighbors, weights, diagonal, right, free, x, iterations, tolerance, tree, scale, inverse):
    """Solve (diagonal - weights) x = right for the free rows of x in place, beginning with x; the others are known.

    The rows of right and x are those of one block of `simd.LANES` labels; all arrays but the inverse have one
    dimension. tree: clusters of the rows; scale and inverse: as from `_coarse`.
    """
    levels, parent, firsts = tree
    n, lanes = len(diagonal), simd.LANES
    lowest = levels[2] - n
    # The residuals of the rows, and their sums over clusters.
    residual, correction = np.zeros(levels[-1] * lanes, np.float32), np.zeros((levels[-1] - n) * lanes, np.float32)
    direction, image = np.zeros(n * lanes, np.float32), np.zeros(n * lanes, np.float32)
    sums = np.zeros((2, _PARTS * lanes), np.float32)
    for part in prange(_PARTS):
        size = simd.splat(np.float32(0))
        for i in range(part * n // _PARTS, (part + 1) * n // _PARTS):
            if free[i]:
                row = i * lanes
                wanted, left = simd.load(right, row), simd.splat(-diagonal[i]) * simd.load(x, row)
                for e in range(starts[i], starts[i + 1]):
                    near = simd.splat(weights[e]) * simd.load(x, neighbors[e] * lanes)
                    if free[neighbors[e]]:
                        left = left + near
                    else:
                        wanted = wanted + near
                simd.store(residual, row, left + wanted)
                size = size + simd.splat(scale[i]) * wanted * wanted
        simd.store(sums[0], part * lanes, size)
    stop = np.maximum(tolerance * tolerance * _added(sums[0]), 1e-30)
    product, step = np.full(lanes, np.inf), np.zeros(lanes, np.float32)
    for iteration in range(iterations + 1):
        for part in prange(_PARTS):
            forward, scaled, tiny = simd.load(step, 0), simd.splat(np.float32(0)), simd.splat(TINY)
            for c in range(part * lowest // _PARTS, (part + 1) * lowest // _PARTS):
                total = simd.splat(np.float32(0))
                for i in range(firsts[c], firsts[c + 1]):
                    if free[i]:
                        row = i * lanes
                        left = simd.load(residual, row) - forward * simd.load(image, row) + tiny - tiny
                        simd.store(residual, row, left)
                        simd.store(x, row, simd.load(x, row) + forward * simd.load(direction, row))
                        scaled = scaled + simd.splat(scale[i]) * left * left
                        total = total + left
                simd.store(residual, (n + c) * lanes, total)
                scaled = scaled + simd.splat(scale[n + c]) * total * total
            simd.store(sums[1], part * lanes, scaled)
        following = _added(sums[1]) + _correct(tree, scale, inverse, residual, correction)
        if iteration == iterations or (following <= stop).all():
            break
        turn = (following / np.maximum(product, 1e-30)).astype(np.float32)
        product = following
        for part in prange(_PARTS):
            back, tiny = simd.load(turn, 0), simd.splat(TINY)
            for c in range(part * lowest // _PARTS, (part + 1) * lowest // _PARTS):
                own = simd.splat(scale[n + c]) * simd.load(residual, (n + c) * lanes)
                shared = own + simd.load(correction, (parent[n + c] - n) * lanes)
                for i in range(firsts[c], firsts[c + 1]):
                    if free[i]:
                        row = i * lanes
                        here = simd.splat(scale[i]) * simd.load(residual, row) + shared
                        simd.store(direction, row, here + back * simd.load(direction, row) + tiny - tiny)
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
    """Fill the corrections of all clusters but the lowest by the residuals of the lowest, from the top level down.

    Return the products (simd.LANES,) of residuals and corrections, where that of a level counts by itself.
    """
    levels, parent, firsts = tree
    n, first, lanes = levels[1], levels[-2], simd.LANES
    for c in range(levels[2], levels[-1]):
        total = simd.splat(np.float32(0))
        for member in range(firsts[c - n], firsts[c - n + 1]):
            total = total + simd.load(residual, member * lanes)
        simd.store(residual, c * lanes, total)
    products = simd.splat(np.float32(0))
    for c in range(len(inverse)):
        total = simd.splat(np.float32(0))
        for other in range(len(inverse)):
            total = total + simd.splat(inverse[c, other]) * simd.load(residual, (first + other) * lanes)
        simd.store(correction, (first + c - n) * lanes, total)
        products = products + total * simd.load(residual, (first + c) * lanes)
    for c in range(first - 1 if len(inverse) else levels[-1] - 1, levels[2] - 1, -1):
        left = simd.load(residual, c * lanes)
        own = simd.splat(scale[c]) * left
        products = products + own * left
        if c < first:
            own = own + simd.load(correction, (parent[c] - n) * lanes)
        simd.store(correction, (c - n) * lanes, own)
    found = np.zeros(lanes, np.float32)
    simd.store(found, 0, products)
    return found


@kernel()
def _coarse(starts, neighbors, weights, diagonal, free, tree):
    """Return what corrects the free rows of (diagonal - weights) x = right, and their clusters.

    Returns:
        The inverse diagonal of each row and cluster, and the matrix of the top level's clusters, (0, 0) where these are
        too many.
    """
    levels, parent = tree[0], tree[1]
    n, count, first = levels[1], levels[-1], levels[-2]
    total, within = np.zeros(count), np.zeros(count)
    few = count - first if count - first <= FEW else 0
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


@kernel()
def _reach(starts, neighbors, labels, reached, queue, count):
    """Mark what is connected with the first `count` nodes of the queue through nodes of the same label."""
    while count > 0:
        count -= 1
        node = queue[count]
        for e in range(starts[node], starts[node + 1]):
            other = neighbors[e]
            if not reached[other] and labels[other] == labels[node]:
                reached[other] = True
                queue[count] = other
                count += 1


def connected_with(weights: sparse.csr_array, labels: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Find what is connected with some nodes through nodes that have the same label.

    Args:
        weights: (N, N) symmetric weights of the edges.
        labels: (N,) int64.
        nodes: (N,) bool, where to begin.

    Returns:
        (N,) bool.
    """
    reached, queue = nodes.copy(), np.empty(len(nodes), np.int64)
    first = np.flatnonzero(nodes)
    queue[: len(first)] = first
    _reach(weights.indptr.astype(np.int32), weights.indices.astype(np.int32), labels, reached, queue, len(first))
    return reached


def best_borders(weights: sparse.csr_array, probabilities: np.ndarray) -> np.ndarray:
    """Choose how far each label reaches into what has none, by where its border is weak.

    As in a sweep of local graph partitioning (Andersen, Chung and Lang 2006), a label may have all nodes of at least
    some probability against none. Of these thresholds, the one is taken with the least weights of the border over all
    edges of what is within, a conductance in which the size and the odds of the threshold have a power.

    Args:
        weights: (n, n) symmetric weights of the edges.
        probabilities: (n, C) as from `random_walker`, of which label 0 is none.

    Returns:
        (n,) int64, the label of each node.
    """
    count, steps = probabilities.shape[1], len(THRESHOLDS)
    if count == 1:
        return np.zeros(len(probabilities), np.int64)
    best = 1 + probabilities[:, 1:].argmax(1)
    part = probabilities[np.arange(len(best)), best]
    within = np.searchsorted(THRESHOLDS, part / np.maximum(part + probabilities[:, 0], 1e-12), side="right")

    def above(nodes: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the sums (C, thresholds) of the values of nodes that are above each threshold of their label."""
        sums = np.bincount(best[nodes] * (steps + 1) + within[nodes], values, count * (steps + 1))
        return sums.reshape(count, -1)[:, :0:-1].cumsum(1)[:, ::-1]

    # An edge is in the border while one end is above the threshold and the other is not, or has another label.
    half = sparse.triu(weights, 1, format="coo")
    first, second = half.coords
    same, is_higher = best[first] == best[second], within[first] >= within[second]
    border = above(first, np.where(same & ~is_higher, -half.data, half.data))
    border += above(second, np.where(same & is_higher, -half.data, half.data))
    edges = np.asarray(weights.sum(axis=1)).ravel()
    inside = above(np.arange(len(best)), edges)
    # Rounding leaves tiny borders and sizes where a label has all nodes, or all that are connected.
    smaller = np.maximum(np.minimum(inside, edges.sum() - inside), _ROUNDING * edges.sum())
    odds = np.maximum(THRESHOLDS, 1 - THRESHOLDS) / np.minimum(THRESHOLDS, 1 - THRESHOLDS)
    conductance = np.maximum(border, 0) * odds**ODDS_POWER / smaller**SIZE_POWER
    conductance[(border <= _ROUNDING * edges.sum()) & (THRESHOLDS < 0.5)] = np.inf
    chosen = conductance.argmin(1)
    return np.where(within > chosen[best], best, 0)


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
        clusters: clusters of the nodes, which make the solution faster; None: only the nodes are corrected.

    Returns:
        (N, labels) float32, which adds up to 1 where a seed or the prior is reached.
    """
    count, labels = prior.shape
    free = seeds < 0
    found = np.zeros((count, labels), np.float32) if start is None else start.astype(np.float32)
    found[~free] = seeds[~free, None] == np.arange(labels)
    diagonal = np.asarray(weights.sum(axis=1)).ravel() + strength * prior.sum(1) + 1e-12
    starts, neighbors = weights.indptr.astype(np.int32), weights.indices.astype(np.int32)
    graph = starts, neighbors, weights.data.astype(np.float32), diagonal.astype(np.float32)
    if clusters is None:
        tree, inverse = no_clusters(count), np.zeros((1, 1), np.float32)
        scale = np.append(1 / graph[3], np.zeros(count + 1, np.float32))
    else:
        tree = clusters
        scale, matrix = _coarse(*graph, free, tree)
        inverse = np.linalg.inv(matrix).astype(np.float32)
    for first in range(0, labels, simd.LANES):
        block = slice(first, min(first + simd.LANES, labels))
        x, right = np.zeros((count, simd.LANES), np.float32), np.zeros((count, simd.LANES), np.float32)
        x[:, : block.stop - first], right[:, : block.stop - first] = found[:, block], strength * prior[:, block]
        _solve(
            *graph, right.ravel(), free, x.ravel(), ITERATIONS if start is None else ITERATIONS_AGAIN, TOLERANCE,
            tree, scale, inverse,
        )  # fmt: skip
        found[:, block] = x[:, : block.stop - first]
    return found


def rough_walker(
    weights: sparse.csr_array, seeds: np.ndarray, prior: np.ndarray, clusters: Clusters, coarse: Coarse
) -> np.ndarray:
    """Find the probability of each label at each node as if all nodes of a cluster had the same, in less time.

    Args:
        weights, seeds, prior, clusters: as for `random_walker`, where the strength is 1.
        coarse: as from `between_clusters`.

    Returns:
        (N, labels) float32.
    """
    count, labels = prior.shape
    cluster, free = clusters.parent[:count] - count, seeds < 0
    firsts = clusters.starts[: coarse.weights.shape[0]]
    # Seeds are no members of their clusters: they are what walkers from there end at.
    known = np.flatnonzero(~free)
    edges = weights[known].tocoo()
    first, second, weight = known[edges.row], edges.col, edges.data
    ending = free[second]
    right = np.add.reduceat(np.where(free[:, None], prior, 0.0), firsts, axis=0)
    np.add.at(right, (cluster[second[ending]], seeds[first[ending]]), weight[ending])
    ends = np.stack([np.append(first, second[ending]), np.append(second, first[ending])])
    here, there = cluster[ends]
    gone = sparse.coo_array((np.append(weight, weight[ending]) * (here != there), (here, there)), coarse.weights.shape)
    between = (coarse.weights - gone.tocsr()).tocsr()
    between.data = np.maximum(between.data, 0.0)
    without = np.where(np.logical_or.reduceat(free, firsts), -1, 0)
    found = random_walker(between, without, right, 1.0, clusters=coarse.clusters)[cluster]
    found[known] = seeds[known, None] == np.arange(labels)
    return found
