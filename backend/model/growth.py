"""Where anchors are added and taken away (Scaffold-GS section 3.3, with IDs as ObjectGS section 3.2).

A child takes its parent's ID, a cell holds at most one anchor, and of two objects that want one free cell the one
with the larger accumulated gradient gets it.

Statistics are gathered where the model lies. Growth itself, once in many steps, thinks on the processor: sorting
cells is what it does, and only what asks for one travels, not the anchors' rows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from .. import device
from .anchors import Anchors, cell_keys, new_rows

LEVELS = (16, 4, 1)
"""Cells tried, in voxels, coarse to fine."""

MIN_VISITS = 5
"""What was seen less often is not judged yet."""


@dataclass
class GrowthStatistics:
    """Sums since they were last judged. gradient and visits (N k,): norm of the screen gradient (normalised device
    coordinates) of each offset's splat, and how often it was seen; opacity and views (N,): summed opacity of an
    anchor's splats, and how often the anchor was in view."""

    gradient: torch.Tensor
    visits: torch.Tensor
    opacity: torch.Tensor
    views: torch.Tensor

    @classmethod
    def zeros(cls, anchors: int, offsets: int, place: torch.device = device.CPU) -> GrowthStatistics:
        """Cleared sums."""

        def cleared(count: int, kind: torch.dtype) -> torch.Tensor:
            return torch.zeros(count, dtype=kind, device=place)

        return cls(
            cleared(anchors * offsets, torch.float32), cleared(anchors * offsets, torch.int32),
            cleared(anchors, torch.float32), cleared(anchors, torch.int32),
        )  # fmt: skip

    def add(
        self,
        anchors_seen: torch.Tensor,
        offsets: int,
        source: torch.Tensor,
        opacities: torch.Tensor,
        drawn: torch.Tensor | np.ndarray,
        screen_gradient: torch.Tensor | np.ndarray,
        width: int,
        height: int,
        usable: torch.Tensor | None = None,
    ) -> None:
        """Take in one step. anchors_seen (n,); source (S,) local anchor * k + offset of each splat; drawn (S,) bool;
        screen_gradient (S, 2) in pixels; usable (n,) bool, on the GPU alone: the other anchors do not count."""
        if device.on_gpu(self.gradient):
            drawn, screen_gradient = torch.as_tensor(drawn), torch.as_tensor(screen_gradient)
            self._add_on_gpu(anchors_seen, offsets, opacities, drawn, screen_gradient, width, height, usable)
            return
        size = np.array([width / 2, height / 2], np.float32)
        norm = np.sqrt(((device.host(screen_gradient) * size) ** 2).sum(1))
        sources, seen = source.numpy(), anchors_seen.numpy()
        shown = device.host(drawn) & np.isfinite(norm)
        place = seen[sources // offsets] * offsets + sources % offsets
        gradient, visits, opacity, views = (t.numpy() for t in (self.gradient, self.visits, self.opacity, self.views))
        gradient[place[shown]] += norm[shown]
        visits[place[shown]] += 1
        opacity += np.bincount(seen[sources // offsets], opacities.numpy(), minlength=len(opacity)).astype(np.float32)
        views[seen] += 1

    def _add_on_gpu(
        self,
        anchors_seen: torch.Tensor,
        offsets: int,
        opacities: torch.Tensor,
        drawn: torch.Tensor,
        screen_gradient: torch.Tensor,
        width: int,
        height: int,
        usable: torch.Tensor | None,
    ) -> None:
        """`add`, where every offset of the anchors has a place among the splats."""
        counted = torch.ones_like(anchors_seen, dtype=torch.bool) if usable is None else usable
        drawn = drawn.view(-1, offsets) & counted[:, None]
        norm = torch.hypot(screen_gradient[:, 0] * (width / 2), screen_gradient[:, 1] * (height / 2))
        norm = norm.view(-1, offsets)
        drawn = drawn & norm.isfinite()
        norm = torch.where(drawn, norm, 0.0)
        # Each anchor is there once, so that nothing depends on the order of the sums.
        self.gradient.view(-1, offsets).index_add_(0, anchors_seen, norm)
        self.visits.view(-1, offsets).index_add_(0, anchors_seen, drawn.to(self.visits.dtype))
        self.opacity.index_add_(0, anchors_seen, torch.where(counted, opacities.view(-1, offsets).sum(1), 0.0))
        self.views.index_add_(0, anchors_seen, counted.to(self.views.dtype))

    def after(self, growth: Growth, offsets: int) -> GrowthStatistics:
        """What goes on after a round of growth: the sums of what was seen too seldom to be judged in it."""

        def follow(sums: torch.Tensor, count: torch.Tensor, width: int) -> torch.Tensor:
            kept = torch.where(count < MIN_VISITS, sums, 0).view(-1, width)[growth.kept]
            return torch.cat([kept, kept.new_zeros((growth.added, width))]).flatten()

        return GrowthStatistics(
            follow(self.gradient, self.visits, offsets), follow(self.visits, self.visits, offsets),
            follow(self.opacity, self.views, 1), follow(self.views, self.views, 1),
        )  # fmt: skip


@dataclass(frozen=True)
class Growth:
    """What one round changed: kept (n,) indices of the anchors that stay, in order; `added` new ones follow them."""

    kept: torch.Tensor
    added: int
    pruned: int


def grow_and_prune(
    anchors: Anchors,
    statistics: GrowthStatistics,
    rng: np.random.Generator,
    threshold: float = 2e-4,
    min_opacity: float = 0.005,
    max_anchors: int = 10**9,
) -> Growth:
    """Add anchors where splats still move much and drop transparent ones, in place.

    A splat of the average gradient >= threshold 2^level asks for the cell of LEVELS[level] voxels that it lies in.
    """
    layout, k = anchors.layout, anchors.layout.offsets
    summed, visits, opacity, views = (
        device.host(t) for t in (statistics.gradient, statistics.visits, statistics.opacity, statistics.views)
    )
    positions = device.host(anchors.positions)
    enough = visits >= MIN_VISITS
    gradient = np.where(enough, summed / np.maximum(visits, 1), 0)
    wanted = np.flatnonzero(gradient >= threshold)
    parents = wanted // k
    axes = np.arange(3)
    columns = np.concatenate(
        [layout.offset_columns.start + 3 * (wanted % k)[:, None] + axes,
         np.broadcast_to(layout.extent_columns.start + axes, (len(wanted), 3))], 1
    )  # fmt: skip
    numbers = device.host(
        anchors.rows[device.upload(parents, anchors.rows)[:, None], device.upload(columns, anchors.rows)]
    )
    means = positions[parents] + numbers[:, :3] * np.exp(numbers[:, 3:])

    new_positions, new_children, new_extents = [], [], []
    room = max_anchors - len(anchors)
    occupied_by = [positions]
    for level, voxels in enumerate(LEVELS):
        cell = anchors.voxel * voxels
        here = gradient[wanted] >= threshold * 2.0**level
        keys = cell_keys(means[here], cell)
        taken = cell_keys(np.concatenate(occupied_by), cell)
        cells = _numbered(np.concatenate([taken, keys]))
        free = ~np.isin(cells[len(taken) :], cells[: len(taken)])
        index = np.flatnonzero(here)[free]
        keys, cells = keys[free], cells[len(taken) :][free]
        # The largest accumulated gradient first; ties by index, so that a seed fixes everything.
        order = np.lexsort((index, -summed[wanted[index]]))
        _, first = np.unique(cells[order], return_index=True)
        chosen = order[np.sort(first)][: max(room, 0)]
        room -= len(chosen)
        found = (keys[chosen] * cell).astype(np.float32)
        occupied_by.append(found)
        new_positions.append(found)
        new_children.append(index[chosen])
        new_extents.append(np.full(len(chosen), np.log(cell), np.float32))

    child = np.concatenate(new_children)
    parent = device.upload(parents[child], anchors.rows)
    of_parents = device.host(anchors.rows[parent])
    rows = new_rows(len(child), layout, rng)
    rows[:, layout.extent_columns] = np.concatenate(new_extents)[:, None]
    rows[:, layout.feature_columns] = of_parents[:, layout.feature_columns]
    colors = of_parents[:, layout.color_columns].reshape(-1, k, 3)[np.arange(len(child)), wanted[child] % k]
    rows[:, layout.color_columns] = np.tile(colors, (1, k))

    faint = (views >= MIN_VISITS) & (opacity < min_opacity * np.maximum(views, 1))
    kept = device.upload(np.flatnonzero(~faint), anchors.rows)
    pruned = len(anchors) - len(kept)
    born = device.upload(np.concatenate(new_positions), anchors.rows)
    anchors.positions = torch.cat([anchors.positions[kept], born])
    anchors.rows = torch.cat([anchors.rows[kept], device.upload(rows, anchors.rows)])
    anchors.ids = torch.cat([anchors.ids[kept], anchors.ids[parent]])
    return Growth(kept, len(child), pruned)


def _numbered(rows: np.ndarray) -> np.ndarray:
    """(n,) int64: a number for each of the rows (n, 3) int64, the same for those that are equal and only for them."""
    low, high = rows.min(0, initial=0), rows.max(0, initial=0)
    spans = [int(last) - int(first) + 1 for first, last in zip(low, high, strict=True)]
    if math.prod(spans) >= 2**63:
        return np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1)
    return (rows - low) @ np.array([spans[1] * spans[2], spans[2], 1], np.int64)
