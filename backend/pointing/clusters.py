"""Nested clusters of a graph's nodes, which are connected strongly, for corrections of whole clusters at once.

As in algebraic multigrid with aggregation by pairs (Notay 2010), the nodes are paired along the edges that are
strongest for one of their ends, then these pairs are, and so on.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import sparse

from ..raster.kernel import kernel

PAIRINGS = 3
"""Number of pairings between two levels, so that a cluster has up to eight members."""

FEW = 400
"""Number of clusters that are few enough for the inverse of a dense matrix."""


class Clusters(NamedTuple):
    """Nested clusters of n nodes, numbered on: the nodes first, then the clusters of each level.

    Attributes:
        levels: (L + 1,) int64, the number of the first member of each level, of which the nodes are the first, and the
            number of all.
        parent: (levels[-2],) int32, the cluster of each member below the top level.
        starts: (levels[-1] - n + 1,) int64, where the members of each cluster begin in `members`.
        members: int32, the members of one cluster after the other, ascending.
    """

    levels: np.ndarray
    parent: np.ndarray
    starts: np.ndarray
    members: np.ndarray


def no_clusters(count: int) -> Clusters:
    """Return the clusters of a graph of `count` nodes without any."""
    return Clusters(np.array([0, count]), np.empty(0, np.int32), np.zeros(1, np.int64), np.empty(0, np.int32))


def nested_clusters(weights: sparse.csr_array) -> Clusters:
    """Find the clusters of a graph; weights: (n, n), symmetric, >= 0, without a diagonal."""
    levels, parents = [0, weights.shape[0]], []
    while weights.shape[0] > FEW or len(levels) == 2:
        count = weights.shape[0]
        of_member = np.arange(count)
        for _ in range(PAIRINGS):
            pair, weights = _paired(weights)
            of_member = pair[of_member]
        if weights.shape[0] == count:
            break
        parents.append(of_member + levels[-1])
        levels.append(levels[-1] + weights.shape[0])
    parent = np.concatenate(parents or [np.empty(0, np.int64)]).astype(np.int32)
    sizes = np.bincount(parent, minlength=levels[-1])[levels[1] :]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    return Clusters(np.array(levels), parent, starts, np.argsort(parent, kind="stable").astype(np.int32))


def _paired(weights: sparse.csr_array) -> tuple[np.ndarray, sparse.csr_array]:
    """Return the pair (n,) of each node, where some pairs have one node only, and the weights between the pairs."""
    edges = weights.tocoo()
    once = edges.row < edges.col
    first, second, weight = edges.row[once], edges.col[once], edges.data[once]
    total = np.asarray(weights.sum(axis=1)).ravel()
    strength = weight / np.minimum(total[first], total[second])
    pair, count = _match(np.argsort(-strength, kind="stable"), first, second, weights.shape[0])
    ends = pair[edges.row], pair[edges.col]
    outside = ends[0] != ends[1]
    between = sparse.coo_array((edges.data[outside], (ends[0][outside], ends[1][outside])), shape=(count, count))
    return pair, between.tocsr()


@kernel()
def _match(order, first, second, count):
    """Pair the ends of edges in order where both are free; return the pair of each node, and the number of pairs."""
    pair, pairs = np.full(count, -1), 0
    for edge in order:
        if pair[first[edge]] < 0 and pair[second[edge]] < 0:
            pair[first[edge]] = pair[second[edge]] = pairs
            pairs += 1
    for node in range(count):
        if pair[node] < 0:
            pair[node] = pairs
            pairs += 1
    return pair, pairs
