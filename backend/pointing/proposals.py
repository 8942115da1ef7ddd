"""Objects that are found without strokes: regions of splats between large planes, concave borders and gaps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from ..labels.regions import MergeTree, cut_tree, merge_tree, stable_regions
from ..shared.defaults import DETAIL
from ..stereo.scene_planes import sides_of_planes
from ..stereo.surface_normals import concavity, measure_normals
from .splat_graph import Edges, SplatGraph

NEIGHBORS = (35, 45, 55, 65)
"""Numbers of neighbors that normals are measured on, more than for strokes, so that plain walls are in one piece."""

_OF_PLANES = 45
"""Number of neighbors that the normals of planes are measured on."""

CONCAVE_AND_COLOR = ((4.0, 0.16), (5.0, 0.2))
"""Weights of the concavity and of a tenth of the CIELAB distance of two splats, as for strokes. Colors hardly count,
since objects have several. Each pair is tried with each number of neighbors, since a single trial is sensitive to its
weights."""

GAP, STEPS, LEAST = 1 / 3, 0.36, 1e-4
"""Weights of the distance and, relative to that of the color, of the step in the photos; least weight of an edge."""

SMALLEST = 0.003
"""Size of the smallest object, as a fraction of all photos' pixels."""

APART = 0.15
"""Regions whose border has a smaller weight on average are never one object: with less, a table may be one with the
things on it, and with more, walls fall into parts."""


def try_regions(graph: SplatGraph, progress: Callable[[int, int], object]) -> MergeTree:
    """Divide a graph's nodes into regions in several ways, and merge the nodes by how often they are in one region.

    In each trial, neighboring regions of splats are merged where their border, on average over all of it, is least
    concave and has the smallest gaps and steps of color; of the tree, the regions are taken that last longest. The
    trials need not agree on large planes: each is one, and its edges to what stands on it are borders.

    Args:
        graph: the graph.
        progress: receives the number of finished trials, and of all.

    Returns:
        The merges of the nodes. What two regions have in common is the fraction of the trials in which the nodes of the
        edges between them are in one region; 0 or 1 at large planes.
    """
    edges, count, whole = graph.edges, len(graph.xyz), float(graph.seen.sum())
    _, near = cKDTree(graph.xyz).query(graph.xyz, k=min(max(NEIGHBORS), count), workers=-1)
    ones = _symmetric(edges, np.ones(len(edges.first)), count)
    agreeing = np.zeros(len(edges.first))
    for done, neighbors in enumerate(NEIGHBORS):
        normal = measure_normals(graph.xyz[near[:, :neighbors]], graph.facing)
        concave = concavity(graph.xyz, normal, edges.first, edges.second)
        for number, (weight, color) in enumerate(CONCAVE_AND_COLOR):
            differences = (
                (weight * concave) ** 2 + (GAP * edges.gap) ** 2
                + (color * edges.color) ** 2 + (STEPS * color * edges.steps) ** 2
            )  # fmt: skip
            tree = merge_tree(_symmetric(edges, LEAST + np.exp(-differences), count), ones, APART)
            found = stable_regions(tree, graph.seen, SMALLEST * whole, APART)
            agreeing += (found[edges.first] == found[edges.second]) & (found[edges.first] >= 0)
            progress(len(CONCAVE_AND_COLOR) * done + number + 1, len(NEIGHBORS) * len(CONCAVE_AND_COLOR))
    agreeing /= len(NEIGHBORS) * len(CONCAVE_AND_COLOR)
    normal = measure_normals(graph.xyz[near[:, :_OF_PLANES]], graph.facing)
    pairs = edges.first, edges.second
    sides = sides_of_planes(graph.xyz, normal, graph.distances, graph.seen, pairs, may_be_bent=True)
    agreeing = np.where(sides == 0, agreeing, sides > 0)
    return merge_tree(_symmetric(edges, agreeing, count), ones, 0.0)


def find_objects(graph: SplatGraph, tree: MergeTree, detail: float = DETAIL) -> np.ndarray:
    """Find the objects of a graph's nodes.

    Args:
        graph: the graph.
        tree: as from `try_regions`.
        detail: the fraction of the trials that must agree that two regions are one, from 0 to 1: more gives more and
            smaller objects, which divide those of a lower detail.

    Returns:
        (n,) int64, the number of each node's object, from 1 by size; 0: none.
    """
    found = cut_tree(tree, detail)
    sizes, least = np.bincount(found, graph.seen), SMALLEST * graph.seen.sum()
    number_of = np.zeros(len(sizes), np.int64)
    kept = [region for region in np.argsort(-sizes, kind="stable").tolist() if sizes[region] >= least]
    number_of[kept] = np.arange(1, len(kept) + 1)
    return number_of[found]


def _symmetric(edges: Edges, values: np.ndarray, count: int) -> sparse.csr_array:
    """Return the values (m,) of edges as a symmetric matrix (count, count); of those in both directions, one counts."""
    low, high = (pick(edges.first, edges.second).astype(np.int64) for pick in (np.minimum, np.maximum))
    _, kept = np.unique(low * count + high, return_index=True)
    half = sparse.coo_array((values[kept], (low[kept], high[kept])), shape=(count, count)).tocsr()
    return (half + half.T).tocsr()
