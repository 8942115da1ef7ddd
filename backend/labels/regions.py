"""Merging of regions whose common borders, or overlaps, say that they belong together."""

from __future__ import annotations

import heapq

import numpy as np
from scipy import sparse

_MANY = 1 / 50
"""Fraction of the regions that have to be merged in a round so that rounds are faster than single steps."""

_PRIMES = (73_856_093, 19_349_663, 1_000_003)


def merge_regions(shared: sparse.csr_array, total: sparse.csr_array, least: float) -> np.ndarray:
    """Merge the two regions that have most in common, until no two have enough (agglomerative, average linkage).

    Two regions have in common the ratio of their entries in `shared` and `total`; those of merged regions are the sums
    over their members, so that the ratio of two regions is the mean over all pairs, weighted by `total`.

    Args:
        shared: (n, n) symmetric, what two regions share, >= 0.
        total: (n, n) symmetric, positive wherever `shared` is; what they could share.
        least: the smallest ratio with which regions are merged.

    Returns:
        (n,) the merged region of each region, from 0.
    """
    member_of = np.arange(shared.shape[0])
    # As one matrix, so that both have their entries in the same places.
    both = (total + 1j * shared).tocsr()
    # Regions that are each other's best match are merged in any order, here as many as possible at once. This is slow
    # where one region is the best match of many others, but of few at a time.
    while (merged := _merged_once(both, least)) is not None:
        before, after = both.shape[0], int(merged.max()) + 1
        contract = sparse.coo_array((np.ones(before), (np.arange(before), merged)), shape=(before, after)).tocsr()
        both = (contract.T @ both @ contract).tocsr()
        member_of = merged[member_of]
        if before - after < _MANY * before:
            return _merged_singly(both, least)[member_of]
    return member_of


def _merged_once(both: sparse.csr_array, least: float) -> np.ndarray | None:
    """Return the region (n,) of each region after one round, or None if no two are merged."""
    pairs = both.tocoo()
    first, second, ratio = pairs.row, pairs.col, pairs.data.imag / pairs.data.real
    good = (first < second) & (ratio >= least)
    first, second, ratio = first[good].astype(np.int64), second[good].astype(np.int64), ratio[good]
    if not len(first):
        return None
    # Equal ratios are in an arbitrary order, since pairs in that of their indices would rarely match mutually.
    order = np.lexsort((first * _PRIMES[0] % _PRIMES[2] ^ second * _PRIMES[1] % _PRIMES[2], -ratio))
    first, second = first[order], second[order]
    place, best = np.arange(len(order)), np.full(both.shape[0], len(order))
    np.minimum.at(best, first, place)
    np.minimum.at(best, second, place)
    mutual = (best[first] == place) & (best[second] == place)
    into = np.arange(both.shape[0])
    into[second[mutual]] = first[mutual]
    return np.unique(into, return_inverse=True)[1]


def _merged_singly(both: sparse.csr_array, least: float) -> np.ndarray:
    """Return the region (n,) of each region after all merges, one after the other."""
    pairs = both.tocoo()
    around: list[dict[int, complex]] = [{} for _ in range(both.shape[0])]
    for first, second, value in zip(pairs.row.tolist(), pairs.col.tolist(), pairs.data.tolist(), strict=True):
        if first != second:
            around[first][second] = value
    heap = [
        (-value.imag / value.real, first, second, value)
        for first, others in enumerate(around)
        for second, value in others.items()
        if first < second and value.imag >= least * value.real
    ]
    heapq.heapify(heap)
    into = list(range(len(around)))
    while heap:
        _, first, second, value = heapq.heappop(heap)
        if around[first].get(second) != value:
            continue
        if len(around[first]) < len(around[second]):
            first, second = second, first
        into[second] = first
        for other, own in around[second].items():
            del around[other][second]
            if other == first:
                continue
            summed = around[first].get(other, 0j) + own
            around[first][other] = around[other][first] = summed
            if summed.imag >= least * summed.real:
                heapq.heappush(heap, (-summed.imag / summed.real, min(first, other), max(first, other), summed))
        around[second] = {}
    for region in range(len(into)):
        while into[into[region]] != into[region]:
            into[region] = into[into[region]]
    return np.unique(into, return_inverse=True)[1]
