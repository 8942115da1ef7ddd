"""Anchors as in Scaffold-GS (Lu et al. 2024), each with an object ID (ObjectGS section 3.2).

All trainable parameters of an anchor are stored in one row of a single matrix, so that the optimizer accesses a visible
anchor once, and a checkpoint consists of few tensors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from ..shared.splats.spherical_harmonics import C0

_QUERIED = 200_000
"""Number of points whose nearest neighbors tell how far apart all are."""

LOG_EXTENT_MAX = 20.0
"""Upper limit of the logarithm of an extent."""


@dataclass(frozen=True)
class Layout:
    """The columns of an anchor's row.

    In this order: offsets in units of the anchor's extent, log extents (3 for the offsets, 3 for the splats' scales),
    features for the heads, and residuals for each offset, which are added to the output of the heads: opacity, scale
    and rotation, base color.

    Attributes:
        offsets: k, number of splats per anchor.
        features: length of an anchor's feature vector.
    """

    offsets: int = 10
    features: int = 32

    @property
    def offset_columns(self) -> slice:
        return slice(0, 3 * self.offsets)

    @property
    def extent_columns(self) -> slice:
        return slice(3 * self.offsets, 3 * self.offsets + 6)

    @property
    def scale_columns(self) -> slice:
        return slice(3 * self.offsets + 3, 3 * self.offsets + 6)

    @property
    def feature_columns(self) -> slice:
        start = 3 * self.offsets + 6
        return slice(start, start + self.features)

    @property
    def opacity_columns(self) -> slice:
        start = self.feature_columns.stop
        return slice(start, start + self.offsets)

    @property
    def shape_columns(self) -> slice:
        start = self.opacity_columns.stop
        return slice(start, start + 7 * self.offsets)

    @property
    def color_columns(self) -> slice:
        start = self.shape_columns.stop
        return slice(start, start + 3 * self.offsets)

    @property
    def columns(self) -> int:
        return self.color_columns.stop


@dataclass
class Anchors:
    """N anchors, on one device.

    Attributes:
        layout: the columns of `rows`.
        voxel: edge length of the finest cell in scene units.
        positions: (N, 3) float32, cell centers in scene units.
        rows: (N, layout.columns) float32, trainable.
        ids: (N,) int32, class index in the model's `ClassTable`.
    """

    layout: Layout
    voxel: float
    positions: torch.Tensor
    rows: torch.Tensor
    ids: torch.Tensor

    def __len__(self) -> int:
        return len(self.positions)

    def to(self, device: torch.device) -> Anchors:
        """Return the anchors on another device; tensors that are already on it are shared."""
        return Anchors(self.layout, self.voxel, self.positions.to(device), self.rows.to(device), self.ids.to(device))


def median_spacing(xyz: np.ndarray) -> float:
    """Compute the median distance of points to their nearest neighbors, of many points from an even sample.

    Args:
        xyz: (M, 3); coincident points are counted once.

    Returns:
        The median; 1/100 of the extent if the median is too small, 1 if there are fewer than two distinct points.
    """
    distinct = np.unique(xyz, axis=0)
    if len(distinct) < 2:
        return 1.0
    distance, _ = cKDTree(distinct).query(distinct[:: -(-len(distinct) // _QUERIED)], k=2)
    spacing = float(np.median(distance[:, 1]))
    extent = float(np.ptp(distinct, axis=0).max())
    return spacing if spacing > 1e-9 * extent else extent / 100


def cell_keys(xyz: np.ndarray, cell: float) -> np.ndarray:
    """Return the cell of each position, (M, 3) int64; cells have the edge `cell` and are centered on its multiples."""
    return np.round(np.asarray(xyz, np.float64) / cell).astype(np.int64)


def seed_anchors(
    xyz: np.ndarray, rgb: np.ndarray, ids: np.ndarray, voxel: float, layout: Layout, rng: np.random.Generator
) -> Anchors:
    """Place one anchor in each voxel that contains points.

    Args:
        xyz: (M, 3) in scene units.
        rgb: (M, 3) in [0, 1].
        ids: (M,) class index.
        voxel: edge length of a voxel in scene units.
        layout: columns of the anchors' rows.
        rng: generator of the offsets.

    Returns:
        Anchors with the majority class of their points (ties: the class of the point nearest to the cell's center) and
        the mean color of the points of that class.
    """
    keys = cell_keys(xyz, voxel)
    cells, inverse = np.unique(keys, axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    n = len(cells)
    positions = (cells * voxel).astype(np.float32)
    distance = np.linalg.norm(xyz - positions[inverse], axis=1)

    pairs, pair_of, votes = np.unique(np.stack([inverse, ids], 1), axis=0, return_inverse=True, return_counts=True)
    pair_of = pair_of.reshape(-1)
    nearest = np.full(len(pairs), np.inf)
    np.minimum.at(nearest, pair_of, distance)
    order = np.lexsort((pairs[:, 1], nearest, -votes, pairs[:, 0]))
    first = order[np.unique(pairs[order, 0], return_index=True)[1]]
    owner = pairs[first, 1].astype(np.int32)

    mine = ids == owner[inverse]
    count = np.maximum(np.bincount(inverse[mine], minlength=n), 1)
    color = np.stack([np.bincount(inverse[mine], rgb[mine, c], minlength=n) / count for c in range(3)], 1)

    rows = new_rows(n, layout, rng)
    neighbors = min(4, n)
    if neighbors > 1:
        spacing = cKDTree(positions).query(positions, k=neighbors)[0][:, 1:].mean(1)
        spacing = np.clip(spacing, voxel, 20 * voxel)
    else:
        spacing = np.full(n, voxel)
    rows[:, layout.extent_columns] = np.log(spacing)[:, None]
    rows[:, layout.color_columns] = np.tile((color - 0.5) / C0, (1, layout.offsets))
    return Anchors(layout, voxel, *(torch.from_numpy(a) for a in (positions, rows, owner)))


def with_surroundings(
    anchors: Anchors, xyz: np.ndarray, rgb: np.ndarray, of_class: int, spacing: float, rng: np.random.Generator
) -> Anchors:
    """Return anchors with further ones for distant surroundings, which are much larger than voxels.

    Args:
        anchors: the anchors, on the CPU.
        xyz: (n, 3) positions in scene units, which are not rounded to voxels.
        rgb: (n, 3) in [0, 1].
        of_class: their class index.
        spacing: distance between neighboring positions in scene units, which becomes the extent of the anchors.
        rng: generator of the offsets.
    """
    layout = anchors.layout
    rows = new_rows(len(xyz), layout, rng)
    rows[:, layout.extent_columns] = np.log(spacing)
    rows[:, layout.color_columns] = np.tile((rgb - 0.5) / C0, (1, layout.offsets))
    added = np.asarray(xyz, np.float32), rows, np.full(len(xyz), of_class, np.int32)
    before = anchors.positions, anchors.rows, anchors.ids
    joined = (torch.cat([old, torch.from_numpy(new)]) for old, new in zip(before, added, strict=True))
    return Anchors(layout, anchors.voxel, *joined)


def new_rows(count: int, layout: Layout, rng: np.random.Generator) -> np.ndarray:
    """Return rows (count, columns) float32 of new anchors: random offsets, everything else 0."""
    rows = np.zeros((count, layout.columns), np.float32)
    rows[:, layout.offset_columns] = rng.normal(0, 0.5, (count, 3 * layout.offsets))
    return rows


def kept_and_added(values: torch.Tensor, kept: torch.Tensor, added: torch.Tensor) -> torch.Tensor:
    """Return torch.cat([values[kept], added]) without a copy of the kept rows in between.

    Args:
        values: (N, ...).
        kept: (n,) int64, indices.
        added: (m, ...).
    """
    result = values.new_empty((len(kept) + len(added), *values.shape[1:]))
    torch.index_select(values, 0, kept, out=result[: len(kept)])
    result[len(kept) :] = added
    return result
