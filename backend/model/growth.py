"""Growing and pruning of anchors (Scaffold-GS section 3.3, with IDs as in ObjectGS section 3.2).

A new anchor inherits its parent's ID. A cell contains at most one anchor; if splats of two objects request the same
free cell, the one with the larger accumulated gradient gets it.

Statistics are accumulated on the model's device. Growth, which is rare, sorts cells on the CPU; only the rows of
anchors whose splats request a cell are copied to the CPU.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from ..gpu.kernel import kernel
from ..raster import devices
from .anchors import Anchors, cell_keys, kept_and_added, new_rows

LEVELS = (16, 4, 1)
"""Edge lengths in voxels of the cells in which anchors are added, coarse to fine."""

MIN_VISITS = 5
"""Smallest number of views in which a splat or anchor must have been seen before it is considered."""


@dataclass
class GrowthStatistics:
    """Sums over views since the splats and anchors were last considered for growth and pruning.

    Attributes:
        gradient: (N k,) float32, norm of the screen gradient (normalized device coordinates) of each offset's splat.
        visits: (N k,) int32, number of views in which the splat was drawn.
        opacity: (N,) float32, total opacity of an anchor's splats.
        views: (N,) int32, number of views in which the anchor was in view.
    """

    gradient: torch.Tensor
    visits: torch.Tensor
    opacity: torch.Tensor
    views: torch.Tensor

    @classmethod
    def zeros(cls, anchors: int, offsets: int, device: torch.device = devices.CPU) -> GrowthStatistics:
        """Return statistics with all sums 0."""

        def cleared(count: int, kind: torch.dtype) -> torch.Tensor:
            return torch.zeros(count, dtype=kind, device=device)

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
        """Add the statistics of a view.

        Args:
            anchors_seen: (n,) int64, the anchors in view.
            offsets: k, number of splats per anchor.
            source: (S,) int64, index in anchors_seen * k + offset of each splat; on a GPU, 0 .. S - 1.
            opacities: (S,), opacities of the splats.
            drawn: (S,) bool, the splats that overlap the image.
            screen_gradient: (S, 2), gradient with respect to the splats' centers in pixels.
            width, height: size of the image in pixels.
            usable: (n,) bool, only on the GPU: anchors for which it is False are ignored.
        """
        if devices.on_gpu(self.gradient):
            kernel("add_statistics").for_each(
                len(anchors_seen), anchors_seen, usable, opacities, torch.as_tensor(drawn),
                torch.as_tensor(screen_gradient), width / 2, height / 2, len(anchors_seen), offsets, self.gradient,
                self.visits, self.opacity, self.views,
            )  # fmt: skip
            return
        size = np.array([width / 2, height / 2], np.float32)
        norm = np.sqrt(((devices.host(screen_gradient) * size) ** 2).sum(1))
        sources, seen = source.numpy(), anchors_seen.numpy()
        shown = devices.host(drawn) & np.isfinite(norm)
        place = seen[sources // offsets] * offsets + sources % offsets
        gradient, visits, opacity, views = (t.numpy() for t in (self.gradient, self.visits, self.opacity, self.views))
        gradient[place[shown]] += norm[shown]
        visits[place[shown]] += 1
        opacity += np.bincount(seen[sources // offsets], opacities.numpy(), minlength=len(opacity)).astype(np.float32)
        views[seen] += 1

    def after(self, growth: Growth, offsets: int) -> GrowthStatistics:
        """Return the statistics after a round of growth; the sums of what was seen too rarely are kept."""

        def follow(sums: torch.Tensor, count: torch.Tensor, width: int) -> torch.Tensor:
            rare = torch.where(count < MIN_VISITS, sums, 0).view(-1, width)
            return kept_and_added(rare, growth.kept, rare.new_zeros((growth.added, width))).flatten()

        return GrowthStatistics(
            follow(self.gradient, self.visits, offsets), follow(self.visits, self.visits, offsets),
            follow(self.opacity, self.views, 1), follow(self.views, self.views, 1),
        )  # fmt: skip


@dataclass(frozen=True)
class Growth:
    """The result of one round.

    The anchors consist of the old ones with the indices `kept` (n,), followed by `added` new ones.
    """

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
    fixed: int = 0,
    allows: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Growth:
    """Add anchors where splats have large gradients and remove transparent ones, in place (Scaffold-GS section 3.3).

    A splat with an average gradient >= threshold * 2^level requests an anchor in its cell of LEVELS[level] voxels.

    Args:
        anchors: changed in place.
        statistics: the statistics since the previous round.
        rng: generator of the offsets of new anchors.
        threshold: average norm of the screen gradient.
        min_opacity: anchors are removed if the total opacity of their splats, averaged over views, is smaller.
        max_anchors: no anchors are added beyond this number, not counting fixed ones.
        fixed: number of anchors, the first ones, that neither grow nor are removed.
        allows: returns for positions (n, 3) where anchors may be added, (n,) bool; None: everywhere.

    Returns:
        The changes.
    """
    layout, k = anchors.layout, anchors.layout.offsets
    summed, visits, opacity, views = (
        devices.host(t) for t in (statistics.gradient, statistics.visits, statistics.opacity, statistics.views)
    )
    positions = devices.host(anchors.positions)
    enough = visits >= MIN_VISITS
    gradient = np.where(enough, summed / np.maximum(visits, 1), 0)
    gradient[: fixed * k] = 0
    wanted = np.flatnonzero(gradient >= threshold)
    parents = wanted // k
    axes = np.arange(3)
    columns = np.concatenate(
        [layout.offset_columns.start + 3 * (wanted % k)[:, None] + axes,
         np.broadcast_to(layout.extent_columns.start + axes, (len(wanted), 3))], 1
    )  # fmt: skip
    numbers = devices.host(
        anchors.rows[devices.upload(parents, anchors.rows)[:, None], devices.upload(columns, anchors.rows)]
    )
    means = positions[parents] + numbers[:, :3] * np.exp(numbers[:, 3:])

    new_positions, new_children, new_extents = [], [], []
    remaining = max_anchors - (len(anchors) - fixed)
    occupied_by = [positions]
    for level, voxels in enumerate(LEVELS):
        cell = anchors.voxel * voxels
        here = gradient[wanted] >= threshold * 2.0**level
        keys = cell_keys(means[here], cell)
        taken = cell_keys(np.concatenate(occupied_by), cell)
        cells = _numbered(np.concatenate([taken, keys]))
        free = ~np.isin(cells[len(taken) :], cells[: len(taken)])
        if allows is not None:
            free &= allows(keys * cell)
        index = np.flatnonzero(here)[free]
        keys, cells = keys[free], cells[len(taken) :][free]
        # The largest accumulated gradient first; ties are broken by index, so that the result is deterministic.
        order = np.lexsort((index, -summed[wanted[index]]))
        _, first = np.unique(cells[order], return_index=True)
        chosen = order[np.sort(first)][: max(remaining, 0)]
        remaining -= len(chosen)
        found = (keys[chosen] * cell).astype(np.float32)
        occupied_by.append(found)
        new_positions.append(found)
        new_children.append(index[chosen])
        new_extents.append(np.full(len(chosen), np.log(cell), np.float32))

    child = np.concatenate(new_children)
    parent = devices.upload(parents[child], anchors.rows)
    of_parents = devices.host(anchors.rows[parent])
    rows = new_rows(len(child), layout, rng)
    rows[:, layout.extent_columns] = np.concatenate(new_extents)[:, None]
    rows[:, layout.feature_columns] = of_parents[:, layout.feature_columns]
    colors = of_parents[:, layout.color_columns].reshape(-1, k, 3)[np.arange(len(child)), wanted[child] % k]
    rows[:, layout.color_columns] = np.tile(colors, (1, k))

    faint = (views >= MIN_VISITS) & (opacity < min_opacity * np.maximum(views, 1))
    faint[:fixed] = False
    kept = devices.upload(np.flatnonzero(~faint), anchors.rows)
    pruned = len(anchors) - len(kept)
    added_positions = devices.upload(np.concatenate(new_positions), anchors.rows)
    anchors.positions = kept_and_added(anchors.positions, kept, added_positions)
    anchors.rows = kept_and_added(anchors.rows, kept, devices.upload(rows, anchors.rows))
    anchors.ids = kept_and_added(anchors.ids, kept, anchors.ids[parent])
    return Growth(kept, len(child), pruned)


def _numbered(rows: np.ndarray) -> np.ndarray:
    """Map the rows (n, 3) int64 to numbers (n,) int64 that are equal if and only if the rows are equal."""
    low, high = rows.min(0, initial=0), rows.max(0, initial=0)
    spans = [int(last) - int(first) + 1 for first, last in zip(low, high, strict=True)]
    if math.prod(spans) >= 2**63:
        return np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1)
    return (rows - low) @ np.array([spans[1] * spans[2], spans[2], 1], np.int64)
