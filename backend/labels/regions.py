"""Merging of regions whose common borders, or overlaps, say that they belong together."""

from __future__ import annotations

import heapq
from typing import NamedTuple

import numpy as np
from scipy import sparse

MANY = 1 / 50
"""Fraction of the regions that have to be merged in a round so that rounds are faster than single steps."""

_PRIMES = (73_856_093, 19_349_663, 1_000_003)


class MergeTree(NamedTuple):
    """The merges of n regions, in the order in which they are made.

    Attributes:
        regions: n.
        first, second: (m,) the merged regions: 0 to n - 1, or n + i for the result of merge i.
        ratios: (m,) what they have in common.
    """

    regions: int
    first: np.ndarray
    second: np.ndarray
    ratios: np.ndarray


def merge_tree(shared: sparse.csr_array, total: sparse.csr_array, least: float) -> MergeTree:
    """Merge the two regions that have most in common, until no two have enough (agglomerative, average linkage).

    Two regions have in common the ratio of their entries in `shared` and `total`; those of merged regions are the sums
    over their members, so that the ratio of two regions is the mean over all pairs, weighted by `total`.

    Args:
        shared: (n, n) symmetric, what two regions share, >= 0.
        total: (n, n) symmetric, positive wherever `shared` is; what they could share.
        least: the smallest ratio with which regions are merged.
    """
    count = shared.shape[0]
    merges: list[tuple[int, int, float]] = []
    # As one matrix, so that both have their entries in the same places.
    both, names = (total + 1j * shared).tocsr(), np.arange(count)
    # Regions that are each other's best match are merged in any order, here as many as possible at once. This is slow
    # where one region is the best match of many others, but of few at a time.
    while True:
        first, second, ratios = mutual_matches(both, least)
        if not len(first):
            break
        into, results = np.arange(both.shape[0]), names.copy()
        into[second] = first
        results[first] = count + len(merges) + np.arange(len(first))
        merges += zip(names[first].tolist(), names[second].tolist(), ratios.tolist(), strict=True)
        kept, merged = np.unique(into, return_inverse=True)
        before, names = both.shape[0], results[kept]
        contract = sparse.coo_array((np.ones(before), (np.arange(before), merged)), shape=(before, len(kept))).tocsr()
        both = (contract.T @ both @ contract).tocsr()
        if before - len(kept) < MANY * before:
            _merge_singly(both, least, names.tolist(), count, merges)
            break
    tree = np.array(merges).reshape(-1, 3)
    return MergeTree(count, tree[:, 0].astype(np.int64), tree[:, 1].astype(np.int64), tree[:, 2])


def merge_regions(shared: sparse.csr_array, total: sparse.csr_array, least: float) -> np.ndarray:
    """Return the merged region (n,) of each region, from 0; the arguments are those of `merge_tree`."""
    return cut_tree(merge_tree(shared, total, least), least)


def cut_tree(tree: MergeTree, least: float) -> np.ndarray:
    """Return the merged region (n,) of each region, from 0, where only those with enough in common are merged.

    With a higher `least`, the regions divide those of a lower one.
    """
    first, second, ratios = tree.first.tolist(), tree.second.tolist(), [np.inf] * tree.regions
    # By rounding, two merged regions may have a little more in common than the parts of one of them.
    for ratio, one, other in zip(tree.ratios.tolist(), first, second, strict=True):
        ratios.append(min(ratio, ratios[one], ratios[other]))
    members = list(range(len(ratios)))
    for i in range(len(first) - 1, -1, -1):
        if ratios[tree.regions + i] >= least:
            members[first[i]] = members[second[i]] = members[tree.regions + i]
    return np.unique(np.array(members[: tree.regions], np.int64), return_inverse=True)[1]


def stable_regions(tree: MergeTree, sizes: np.ndarray, smallest: float, least: float) -> np.ndarray:
    """Choose the regions of a tree that stay as they are for longest while ever less has to be in common.

    As in HDBSCAN (Campello et al. 2013), a region begins where it reaches the smallest size or two such regions are
    merged, and ends where it is merged with another such region. It is chosen if its size times the logarithm of the
    ratio of both ends is larger than the sum over the regions in it.

    Args:
        tree: the merges.
        sizes: (n,) sizes of the regions.
        smallest: smallest size of a region that counts.
        least: the ratio at which the regions end that are not merged, that of the tree.

    Returns:
        (n,) the chosen region of each region, from 0; -1: none.
    """
    count, merges = tree.regions, len(tree.first)
    size = np.concatenate([sizes, np.zeros(merges)])
    cluster = np.full(count + merges, -1)
    begin: list[float] = []
    end: list[float] = []
    top: list[int] = []
    inside: list[tuple[int, ...]] = []

    def add(node: int, ratio: float, parts: tuple[int, ...]) -> int:
        begin.append(min(ratio, *(begin[part] for part in parts)) if parts else ratio)
        end.append(least)
        top.append(node)
        inside.append(parts)
        return len(top) - 1

    for i, (first, second, ratio) in enumerate(
        zip(tree.first.tolist(), tree.second.tolist(), tree.ratios.tolist(), strict=True)
    ):
        node = count + i
        size[node] = size[first] + size[second]
        one, other = int(cluster[first]), int(cluster[second])
        if one >= 0 and other >= 0:
            end[one] = end[other] = ratio
            cluster[node] = add(node, ratio, (one, other))
        elif max(one, other) >= 0:
            cluster[node] = max(one, other)
            top[max(one, other)] = node
        elif size[node] >= smallest:
            cluster[node] = add(node, ratio, ())
    worth, is_chosen = np.zeros(len(top)), np.zeros(len(top), bool)
    for each, parts in enumerate(inside):
        own = max(np.log(begin[each] / end[each]), 0.0) * size[top[each]]
        of_parts = sum(worth[part] for part in parts)
        is_chosen[each] = not parts or own >= of_parts
        worth[each] = own if is_chosen[each] else of_parts
    label = np.full(count + merges, -1)
    waiting = sorted(set(range(len(top))) - {part for parts in inside for part in parts})
    chosen = 0
    while waiting:
        each = waiting.pop()
        if is_chosen[each]:
            label[top[each]] = chosen
            chosen += 1
        else:
            waiting += inside[each]
    for i in range(merges - 1, -1, -1):
        if label[count + i] >= 0:
            label[tree.first[i]] = label[tree.second[i]] = label[count + i]
    return label[:count]


def mutual_matches(both: sparse.csr_array, least: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pairs of regions that are each other's best match, and what they have in common.

    Args:
        both: (n, n), what two regions could share, plus what they share as imaginary part.
        least: the smallest ratio of both with which regions match.
    """
    pairs = both.tocoo()
    first, second, ratio = pairs.row, pairs.col, pairs.data.imag / pairs.data.real
    good = (first < second) & (ratio >= least)
    first, second, ratio = first[good].astype(np.int64), second[good].astype(np.int64), ratio[good]
    # Equal ratios are in an arbitrary order, since pairs in that of their indices would rarely match mutually.
    order = np.lexsort((first * _PRIMES[0] % _PRIMES[2] ^ second * _PRIMES[1] % _PRIMES[2], -ratio))
    first, second, ratio = first[order], second[order], ratio[order]
    place, best = np.arange(len(order)), np.full(both.shape[0], len(order))
    np.minimum.at(best, first, place)
    np.minimum.at(best, second, place)
    mutual = (best[first] == place) & (best[second] == place)
    return first[mutual], second[mutual], ratio[mutual]


def _merge_singly(
    both: sparse.csr_array, least: float, names: list[int], count: int, merges: list[tuple[int, int, float]]
) -> None:
    """Merge the named regions one after the other, and add to the merges of `count` regions."""
    pairs = both.tocoo()
    around: list[dict[int, complex]] = [{} for _ in names]
    for first, second, value in zip(pairs.row.tolist(), pairs.col.tolist(), pairs.data.tolist(), strict=True):
        if first != second:
            around[first][second] = value
    heap = [
        (-value.imag / value.real, first, second, value.real, value.imag)
        for first, others in enumerate(around)
        for second, value in others.items()
        if first < second and value.imag >= least * value.real
    ]
    heapq.heapify(heap)
    while heap:
        negative, first, second, real, imag = heapq.heappop(heap)
        if around[first].get(second) != complex(real, imag):
            continue
        if len(around[first]) < len(around[second]):
            first, second = second, first
        merges.append((names[first], names[second], -negative))
        names[first] = count + len(merges) - 1
        for other, own in around[second].items():
            del around[other][second]
            if other == first:
                continue
            summed = around[first].get(other, 0j) + own
            around[first][other] = around[other][first] = summed
            if summed.imag >= least * summed.real:
                low, high = min(first, other), max(first, other)
                heapq.heappush(heap, (-summed.imag / summed.real, low, high, summed.real, summed.imag))
        around[second] = {}
