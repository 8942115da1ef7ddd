"""Where anchors are added and taken away (Scaffold-GS section 3.3, with IDs as ObjectGS section 3.2).

A child takes its parent's ID, a cell holds at most one anchor, and of two objects that want one free cell the one
with the larger accumulated gradient gets it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .anchors import Anchors, cell_keys, new_rows

LEVELS = (16, 4, 1)
"""Cells tried, in voxels, coarse to fine."""


@dataclass
class GrowthStatistics:
    """Sums since they were last cleared. gradient and visits (N k,): norm of the screen gradient (normalised device
    coordinates) of each offset's splat, and how often it was seen; opacity and views (N,): summed opacity of an
    anchor's splats, and how often the anchor was in view."""

    gradient: np.ndarray
    visits: np.ndarray
    opacity: np.ndarray
    views: np.ndarray

    @classmethod
    def zeros(cls, anchors: int, offsets: int) -> GrowthStatistics:
        """Cleared sums."""
        return cls(
            np.zeros(anchors * offsets, np.float32), np.zeros(anchors * offsets, np.int32),
            np.zeros(anchors, np.float32), np.zeros(anchors, np.int32),
        )  # fmt: skip

    def add(
        self,
        anchors_seen: np.ndarray,
        offsets: int,
        source: np.ndarray,
        opacities: np.ndarray,
        drawn: np.ndarray,
        screen_gradient: np.ndarray,
        width: int,
        height: int,
    ) -> None:
        """Take in one step. anchors_seen (n,); source (S,) local anchor * k + offset of each splat; drawn (S,) bool;
        screen_gradient (S, 2) in pixels."""
        size = np.array([width / 2, height / 2], np.float32)
        norm = np.sqrt(((screen_gradient * size) ** 2).sum(1))
        place = anchors_seen[source // offsets] * offsets + source % offsets
        self.gradient[place[drawn]] += norm[drawn]
        self.visits[place[drawn]] += 1
        self.opacity += np.bincount(anchors_seen[source // offsets], opacities, minlength=len(self.opacity)).astype(
            np.float32
        )
        self.views[anchors_seen] += 1


@dataclass(frozen=True)
class Growth:
    """What one round changed: kept (n,) indices of the anchors that stay, in order; `added` new ones follow them."""

    kept: np.ndarray
    added: int
    pruned: int


def grow_and_prune(
    anchors: Anchors,
    statistics: GrowthStatistics,
    min_visits: int,
    rng: np.random.Generator,
    threshold: float = 2e-4,
    min_opacity: float = 0.005,
    max_anchors: int = 10**9,
) -> Growth:
    """Add anchors where splats still move much and drop transparent ones, in place.

    A splat of the average gradient >= threshold 2^level asks for the cell of LEVELS[level] voxels that it lies in.
    """
    layout, k = anchors.layout, anchors.layout.offsets
    enough = statistics.visits >= min_visits
    gradient = np.where(enough, statistics.gradient / np.maximum(statistics.visits, 1), 0)
    wanted = np.flatnonzero(gradient >= threshold)
    parents = wanted // k
    offsets = anchors.rows[:, layout.offset_columns].reshape(-1, 3)[wanted]
    extents = np.exp(anchors.rows[parents][:, layout.extent_columns][:, :3])
    means = anchors.positions[parents] + offsets * extents

    new_positions, new_parents, new_offsets, new_extents = [], [], [], []
    room = max_anchors - len(anchors)
    occupied_by = [anchors.positions]
    for level, voxels in enumerate(LEVELS):
        cell = anchors.voxel * voxels
        here = gradient[wanted] >= threshold * 2.0**level
        keys = cell_keys(means[here], cell)
        taken = cell_keys(np.concatenate(occupied_by), cell)
        free = ~_isin_rows(keys, taken)
        index = np.flatnonzero(here)[free]
        keys = keys[free]
        # The largest accumulated gradient first; ties by index, so that a seed fixes everything.
        order = np.lexsort((index, -statistics.gradient[wanted[index]]))
        _, first = np.unique(keys[order], axis=0, return_index=True)
        chosen = order[np.sort(first)][: max(room, 0)]
        room -= len(chosen)
        positions = (keys[chosen] * cell).astype(np.float32)
        occupied_by.append(positions)
        new_positions.append(positions)
        new_parents.append(parents[index[chosen]])
        new_offsets.append(wanted[index[chosen]] % k)
        new_extents.append(np.full(len(chosen), np.log(cell), np.float32))

    parent = np.concatenate(new_parents)
    slot = np.concatenate(new_offsets)
    rows = new_rows(len(parent), layout, rng)
    rows[:, layout.extent_columns] = np.concatenate(new_extents)[:, None]
    rows[:, layout.feature_columns] = anchors.rows[parent][:, layout.feature_columns]
    colors = anchors.rows[parent][:, layout.color_columns].reshape(-1, k, 3)[np.arange(len(parent)), slot]
    rows[:, layout.color_columns] = np.tile(colors, (1, k))

    faint = (statistics.views >= min_visits) & (statistics.opacity < min_opacity * np.maximum(statistics.views, 1))
    kept = np.flatnonzero(~faint)
    pruned = len(anchors) - len(kept)
    anchors.positions = np.concatenate([anchors.positions[kept], *new_positions])
    anchors.rows, anchors.ids = (
        np.concatenate([anchors.rows[kept], rows]),
        np.concatenate([anchors.ids[kept], anchors.ids[parent]]),
    )
    return Growth(kept, len(parent), pruned)


def _isin_rows(rows: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Which rows (n, 3) int64 occur among others (m, 3)."""
    everything = np.concatenate([others, rows])
    _, inverse = np.unique(everything, axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    present = np.zeros(inverse.max(initial=-1) + 1, np.bool_)
    present[inverse[: len(others)]] = True
    return present[inverse[len(others) :]]
