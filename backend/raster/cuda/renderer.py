"""The CUDA renderer on tensors in device memory; see `backend.raster` for the torch interface, and cpu/renderer.py."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch

from ..camera import Camera
from ..discs import TILT_COLUMNS
from ..splats import GRADIENT_COLUMNS, HALF_H, SPLAT_COLUMNS, gradient_columns, view_of
from .binning import IntersectionCount, Intersections, depth_order, grid, tile_intersections
from .blending import blend_kernel
from .blending_backward import blend_backward_kernel
from .ids import most_probable
from .kernel import launch, launch_for_each
from .projection import SPLATS_PER_BLOCK, project_backward_kernel, project_kernel
from .staging import THREADS, Wanted


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
    launch_for_each(
        project_kernel(flat), count, g.means, g.quats, g.scales, g.opacities, g.sh, view, np.int32(width),
        np.int32(height), splats, splats if tilts is None else tilts, outlines,
    )  # fmt: skip
    order = depth_order(splats, outlines, g.ids, width, height)
    total = IntersectionCount(order.cumulative)
    columns, lines = grid(width, height)

    def planes(wanted: bool, *shape: int) -> torch.Tensor | None:
        return torch.empty((*shape, height, width), device=device) if wanted else None

    color = torch.empty((3, height, width), device=device)
    transmittance = torch.empty((height, width), device=device)
    label_probability, depth, median = planes(labels is not None), planes(want_depth), planes(want_median)
    normals, moments = planes(want_normals, 3), planes(want_moments, 2)
    isect_counts = torch.empty(columns * lines, dtype=torch.int32, device=device)
    wanted = Wanted(flat, labels is not None, want_depth, want_median, want_normals, want_moments)
    capacity = total.expected_capacity()
    while True:
        intersections = tile_intersections(order, outlines, width, height, capacity)
        launch(
            blend_kernel(wanted), columns * lines, THREADS, *_kernel_inputs(splats, tilts, g.ids, labels),
            intersections.isect_offsets, intersections.isect_ids, np.int32(columns), color, transmittance,
            _or(label_probability, transmittance), _or(depth, transmittance), _or(median, transmittance),
            _or(normals, color), _or(moments, color), isect_counts,
        )  # fmt: skip
        needed = total.wait()
        if needed <= capacity:
            break
        capacity = needed
    return Frame(
        g, camera, labels, color, transmittance, label_probability, depth, median, normals, moments, splats, tilts,
        view, intersections, isect_counts,
    )  # fmt: skip


def _or(plane: torch.Tensor | None, stand_in: torch.Tensor) -> torch.Tensor:
    """Return the plane, or `stand_in` if it is None, since a kernel requires an argument also for unused planes."""
    return stand_in if plane is None else plane


def _kernel_inputs(
    splats: torch.Tensor, tilts: torch.Tensor | None, ids: torch.Tensor, labels: torch.Tensor | None
) -> tuple[torch.Tensor, ...]:
    """Return splats, tilts, IDs and labels for the kernels, with at least one element each."""
    if not splats.shape[0]:
        splats = splats.new_empty((1, SPLAT_COLUMNS))
        tilts, ids = splats, ids.new_empty(1)
    return splats, _or(tilts, splats), ids, _or(labels, ids.view(1, -1))


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
    wanted = Wanted(
        flat, frame.labels is not None and g_label_probability is not None,
        frame.depth is not None and g_depth is not None, False,
        frame.normals is not None and g_normals is not None, frame.moments is not None and g_moments is not None,
    )  # fmt: skip
    intersections, plane = frame.intersections, frame.transmittance
    columns, lines = grid(frame.camera.width, frame.camera.height)
    rows = g.means.new_empty((intersections.capacity, GRADIENT_COLUMNS * (2 if wanted.normals else 1)))
    launch(
        blend_backward_kernel(wanted), columns * lines, THREADS,
        *_kernel_inputs(frame.splats, frame.tilts, g.ids, frame.labels), intersections.isect_offsets,
        intersections.isect_ids, intersections.isect_rows, frame.isect_counts, np.int32(columns), frame.color, plane,
        _or(frame.label_probability, plane), _or(frame.depth, plane), _or(frame.normals, frame.color),
        _or(frame.moments, frame.color), g_color, g_alpha, _or(g_label_probability, plane), _or(g_depth, plane),
        _or(g_normals, frame.color), _or(g_moments, frame.color), rows,
    )  # fmt: skip
    out = Gaussians(
        torch.empty_like(g.means), torch.empty_like(g.quats), torch.empty_like(g.scales),
        torch.empty_like(g.opacities), torch.empty_like(g.sh), g.ids.new_empty(0),
    )  # fmt: skip
    frame.screen_gradient = g.means.new_empty((count, 2))
    kernel = project_backward_kernel(flat, gradient_columns(flat, wanted.normals))
    launch(
        kernel, -(-count // SPLATS_PER_BLOCK), SPLATS_PER_BLOCK, g.means, g.quats, g.scales, g.opacities, g.sh,
        frame.view, frame.splats, _or(frame.tilts, frame.splats), intersections.first_rows, intersections.last_rows,
        rows, out.means, out.quats, out.scales, out.opacities, out.sh, frame.screen_gradient,
    )  # fmt: skip
    return out


def object_ranks(frame: Frame, ranks: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Rank the most probable IDs of each pixel; see `backend.raster.object_ranks`."""
    best_probability = frame.transmittance.new_zeros((ranks, *frame.transmittance.shape))
    best_id = torch.full_like(best_probability, -1, dtype=torch.int32)
    splats, tilts, ids, _ = _kernel_inputs(frame.splats, frame.tilts, frame.gaussians.ids, None)
    columns, _ = grid(frame.camera.width, frame.camera.height)
    most_probable(
        splats,
        None if frame.tilts is None else tilts,
        ids,
        frame.intersections,
        frame.isect_counts,
        columns,
        best_id,
        best_probability,
    )
    return best_id, best_probability
