"""The GPU renderer on tensors in device memory; see `backend.raster` for the torch interface, and cpu/renderer.py."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from ..camera import Camera
from ..discs import TILT_COLUMNS
from ..splats import GRADIENT_COLUMNS, HALF_H, SPLAT_COLUMNS, gradient_columns, view_of
from .binning import IntersectionCount, Intersections, depth_order, grid, tile_intersections
from .ids import most_probable
from .kernels import SPLATS_PER_BLOCK, THREADS, raster_kernel

_MOST_INTERSECTIONS = 2**31 - 1
"""Largest number that torch sorts at once."""


@dataclass
class Gaussians:
    """Parameters of Gaussians, as contiguous tensors.

    means (N, 3), quats (N, 4) wxyz of any length, scales (N, 3) linear, opacities (N,), sh (N, K, 3): float32; ids (N,)
    int32.
    """

    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    sh: torch.Tensor
    ids: torch.Tensor


@dataclass
class Frame:
    """A rendered image and the data for its gradient; as `backend.raster.cpu.renderer.Frame`, with tensors."""

    gaussians: Gaussians
    camera: Camera
    labels: torch.Tensor | None
    color: torch.Tensor
    transmittance: torch.Tensor
    label_probability: torch.Tensor | None
    depth: torch.Tensor | None
    median: torch.Tensor | None
    surface: torch.Tensor | None
    normals: torch.Tensor | None
    moments: torch.Tensor | None
    splats: torch.Tensor
    tilts: torch.Tensor | None
    view: torch.Tensor
    intersections: Intersections
    isect_counts: torch.Tensor
    screen_gradient: torch.Tensor | None = field(default=None)

    @property
    def seen(self) -> torch.Tensor:
        """(N,) bool: splats whose footprint overlaps the image."""
        return self.splats[:, HALF_H] > 0


def forward(
    gaussians: Gaussians,
    camera: Camera,
    labels: torch.Tensor | None = None,
    want_depth: bool = False,
    want_median: bool = False,
    want_surface: bool = False,
    want_normals: bool = False,
    want_moments: bool = False,
    flat: bool = False,
) -> Frame:
    """Render `gaussians`, as discs if `flat`; as `backend.raster.cpu.renderer.forward`."""
    g = gaussians
    device = g.means.device
    count, height, width = g.means.shape[0], int(camera.height), int(camera.width)
    splats = torch.empty((count, SPLAT_COLUMNS), device=device)
    tilts = torch.empty((count, TILT_COLUMNS), device=device) if flat else None
    outlines = torch.empty((count, SPLAT_COLUMNS), device=device) if flat else splats
    view = torch.from_numpy(view_of(camera, flat)).to(device, non_blocking=True)
    raster_kernel("project", FLAT=flat, COEFFICIENTS=g.sh.shape[1]).for_each(
        count, g.means, g.quats, g.scales, g.opacities, g.sh, view, count, width, height, splats, tilts,
        outlines if flat else None,
    )  # fmt: skip
    order = depth_order(splats, outlines, g.ids, width, height)
    columns, lines = grid(width, height)
    total = IntersectionCount(order.cumulative, columns * lines)

    def planes(wanted: bool, *shape: int) -> torch.Tensor | None:
        return torch.empty((*shape, height, width), device=device) if wanted else None

    color = torch.empty((3, height, width), device=device)
    transmittance = torch.empty((height, width), device=device)
    label_probability, depth = planes(labels is not None), planes(want_depth)
    median, surface = planes(want_median), planes(want_surface)
    normals, moments = planes(want_normals, 3), planes(want_moments, 2)
    isect_counts = torch.empty(columns * lines, dtype=torch.int32, device=device)
    blend = raster_kernel(
        "blend", FLAT=flat, LABELS=labels is not None, DEPTHS=want_depth, MEDIAN=want_median, SURFACE=want_surface,
        NORMALS=want_normals, MOMENTS=want_moments,
    )  # fmt: skip
    capacity = min(total.expected_capacity(), _MOST_INTERSECTIONS)
    while True:
        intersections = tile_intersections(order, outlines, width, height, capacity)
        blend(
            columns * lines, THREADS, splats, tilts, g.ids, labels, intersections.isect_offsets,
            intersections.isect_ids, columns, width, height, color, transmittance, label_probability, depth, median,
            surface, normals, moments, isect_counts,
        )  # fmt: skip
        needed = total.wait()
        if needed <= capacity:
            break
        if needed > _MOST_INTERSECTIONS:
            raise torch.cuda.OutOfMemoryError(f"{needed} intersections of tiles and splats are too many to be sorted")
        capacity = needed
    return Frame(
        g, camera, labels, color, transmittance, label_probability, depth, median, surface, normals, moments, splats,
        tilts, view, intersections, isect_counts,
    )  # fmt: skip


def backward(
    frame: Frame,
    g_color: torch.Tensor,
    g_alpha: torch.Tensor,
    g_label_probability: torch.Tensor | None = None,
    g_depth: torch.Tensor | None = None,
    g_normals: torch.Tensor | None = None,
    g_moments: torch.Tensor | None = None,
) -> Gaussians:
    """Compute the gradients of a frame's Gaussians; as `backend.raster.cpu.renderer.backward`."""
    g = frame.gaussians
    flat = frame.tilts is not None
    count = g.means.shape[0]
    labels = frame.labels if g_label_probability is not None else None
    with_normals = frame.normals is not None and g_normals is not None
    columns_of_row = gradient_columns(flat, with_normals)
    row = GRADIENT_COLUMNS * (2 if with_normals else 1)
    blend_backward = raster_kernel(
        "blend_backward", FLAT=flat, LABELS=labels is not None, DEPTHS=frame.depth is not None and g_depth is not None,
        NORMALS=with_normals, MOMENTS=frame.moments is not None and g_moments is not None, COLUMNS=columns_of_row,
        ROW=row,
    )  # fmt: skip
    intersections = frame.intersections
    height, width = frame.transmittance.shape
    columns, lines = grid(width, height)
    rows = g.means.new_empty((intersections.capacity, row))
    blend_backward(
        columns * lines, THREADS, frame.splats, frame.tilts, g.ids, labels, intersections.isect_offsets,
        intersections.isect_ids, intersections.isect_rows, frame.isect_counts, columns, width, height, frame.color,
        frame.transmittance, frame.label_probability, frame.depth, frame.normals, frame.moments, g_color, g_alpha,
        g_label_probability, g_depth, g_normals, g_moments, rows,
    )  # fmt: skip
    out = Gaussians(
        torch.empty_like(g.means), torch.empty_like(g.quats), torch.empty_like(g.scales),
        torch.empty_like(g.opacities), torch.empty_like(g.sh), g.ids.new_empty(0),
    )  # fmt: skip
    frame.screen_gradient = g.means.new_empty((count, 2))
    raster_kernel(
        "project_backward", FLAT=flat, COEFFICIENTS=g.sh.shape[1], NORMALS=with_normals, COLUMNS=columns_of_row, ROW=row
    )(
        -(-count // SPLATS_PER_BLOCK), SPLATS_PER_BLOCK, g.means, g.quats, g.scales, g.opacities, g.sh, frame.view,
        frame.splats, intersections.first_rows, intersections.last_rows, rows, count, out.means,
        out.quats, out.scales, out.opacities, out.sh, frame.screen_gradient,
    )  # fmt: skip
    return out


def object_ranks(frame: Frame, ranks: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Rank the most probable IDs of each pixel; see `backend.raster.object_ranks`."""
    best_probability = frame.transmittance.new_zeros((ranks, *frame.transmittance.shape))
    best_id = torch.full_like(best_probability, -1, dtype=torch.int32)
    columns, _ = grid(frame.camera.width, frame.camera.height)
    most_probable(
        frame.splats, frame.tilts, frame.gaussians.ids, frame.intersections, frame.isect_counts, columns, best_id,
        best_probability,
    )  # fmt: skip
    return best_id, best_probability
