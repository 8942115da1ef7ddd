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
    """Two levels or more of clusters of n nodes, numbered on: the nodes first, then the clusters of each level.

    Attributes:
        levels: (L + 1,) int64, the number of the first member of each level, of which the nodes are the first, and the
            number of all.
        parent: (levels[-2],) int32, ascending: the cluster of each member below the top level.
        starts: (levels[-1] - n + 1,) int64, the first member of each cluster, and levels[-2]; those of a cluster have
            successive numbers.
    """

    levels: np.ndarray
    parent: np.ndarray
    starts: np.ndarray


def no_clusters(count: int) -> Clusters:
    """Return the clusters of `count` nodes where none are known: each node by itself, and all of them together."""
    parent = np.append(np.arange(count, 2 * count), np.full(count, 2 * count)).astype(np.int32)
    return Clusters(np.array([0, count, 2 * count, 2 * count + 1]), parent, np.append(np.arange(count + 1), 2 * count))


class Coarse(NamedTuple):
    """The clusters of the lowest level as the nodes of a graph.

    Attributes:
        weights: (m, m) sums of the weights between the clusters.
        clusters: the higher levels, as clusters of them.
    """

    weights: sparse.csr_array
    clusters: Clusters


def nested_clusters(weights: sparse.csr_array) -> tuple[np.ndarray, Clusters]:
    """Find the clusters of a graph.

    Args:
        weights: (n, n), symmetric, >= 0, without a diagonal.

    Returns:
        An order (n,) of the nodes, and their clusters in this order.
    """
    of_member: list[np.ndarray] = []
    while weights.shape[0] > FEW or len(of_member) < 2:
        cluster = np.arange(weights.shape[0])
        for _ in range(PAIRINGS):
            pair, weights = _paired(weights)
            cluster = pair[cluster]
        if weights.shape[0] == len(cluster) and len(of_member) >= 2:
            break
        of_member.append(cluster)
    # From the top down, the members of the clusters in the order of these.
    order, parents, sizes = np.arange(weights.shape[0]), [], []
    for cluster in reversed(of_member):
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        order = np.argsort(place[cluster], kind="stable")
        parents.append(place[cluster][order])
        sizes.append(len(place))
    levels = np.concatenate([[0], np.cumsum([len(order), *reversed(sizes)])])
    parent = np.concatenate([part + first for part, first in zip(reversed(parents), levels[1:], strict=False)])
    starts = np.searchsorted(parent, np.arange(levels[1], levels[-1] + 1))
    return order, Clusters(levels, parent.astype(np.int32), starts)


def between_clusters(weights: sparse.csr_array, clusters: Clusters) -> Coarse | None:
    """Return the graph of the lowest level's clusters, or None if there are less than three levels.

    Args:
        weights: (n, n), symmetric, >= 0.
        clusters: clusters of its nodes.
    """
    levels, parent, starts = clusters
    if len(levels) < 5:
        return None
    n, count = levels[1], levels[2] - levels[1]
    edges, cluster = weights.tocoo(), parent[:n] - n
    ends = cluster[edges.row], cluster[edges.col]
    outside = ends[0] != ends[1]
    between = sparse.coo_array(
        (edges.data[outside], (ends[0][outside], ends[1][outside])), shape=(count, count)
    ).tocsr()
    return Coarse(between, Clusters(levels[1:] - n, (parent[n:] - n).astype(np.int32), starts[count:] - n))


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
    other = np.arange(count)
    for edge in order:
        if other[first[edge]] == first[edge] and other[second[edge]] == second[edge]:
            other[first[edge]], other[second[edge]] = second[edge], first[edge]
    # Nodes that are close in memory should remain so.
    pair, pairs = np.empty(count, np.int64), 0
    for node in range(count):
        if other[node] < node:
            pair[node] = pair[other[node]]
        else:
            pair[node] = pairs
            pairs += 1
    return pair, pairs
