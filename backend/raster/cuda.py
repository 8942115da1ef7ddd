"""The CUDA renderer: tensors on the device in, pictures and gradients on it out. See `backend.raster` for the torch
interface and cpu.py for the same on the CPU."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch

from .camera import Camera
from .cuda_bin import Lists, Total, depth_order, grid, tile_lists
from .cuda_ids import most_probable
from .cuda_kernel import launch, launch_for_each
from .cuda_project import SPLATS_A_BLOCK, project_backward_kernel, project_kernel
from .cuda_tiles import THREADS, Wanted, blend_backward_kernel, blend_kernel
from .discs import TILT_COLUMNS
from .splats import GRADIENT_COLUMNS, HALF_H, SPLAT_COLUMNS, gradient_columns, view_of


@dataclass
class Gaussians:
    """Contiguous float32 tensors: means (N, 3), quats (N, 4) wxyz of any length, scales (N, 3) linear, opacities (N,),
    sh (N, K, 3); and ids (N,) int32."""

    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    sh: torch.Tensor
    ids: torch.Tensor


@dataclass
class Frame:
    """A picture and what its gradient needs; as `cpu.Frame`, with tensors."""

    gaussians: Gaussians
    camera: Camera
    labels: torch.Tensor | None
    color: torch.Tensor
    transmittance: torch.Tensor
    weight: torch.Tensor | None
    depth: torch.Tensor | None
    median: torch.Tensor | None
    normals: torch.Tensor | None
    moments: torch.Tensor | None
    splats: torch.Tensor
    tilts: torch.Tensor | None
    view: torch.Tensor
    lists: Lists
    ends: torch.Tensor
    screen_gradient: torch.Tensor | None = field(default=None)

    @property
    def seen(self) -> torch.Tensor:
        """(N,) bool: splats whose footprint meets the picture."""
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
    """Draw `gaussians`, as discs if `flat`; as `cpu.forward`."""
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
    total = Total(order.ends)
    columns, lines = grid(width, height)

    def planes(wanted: bool, *shape: int) -> torch.Tensor | None:
        return torch.empty((*shape, height, width), device=device) if wanted else None

    color = torch.empty((3, height, width), device=device)
    transmittance = torch.empty((height, width), device=device)
    weight, depth, median = planes(labels is not None), planes(want_depth), planes(want_median)
    normals, moments = planes(want_normals, 3), planes(want_moments, 2)
    ends = torch.empty(columns * lines, dtype=torch.int32, device=device)
    wanted = Wanted(flat, labels is not None, want_depth, want_median, want_normals, want_moments)
    room = total.room()
    while True:
        lists = tile_lists(order, outlines, width, height, room)
        launch(
            blend_kernel(wanted), columns * lines, THREADS, *_drawn(splats, tilts, g.ids, labels), lists.starts,
            lists.members, np.int32(columns), color, transmittance, _or(weight, transmittance),
            _or(depth, transmittance), _or(median, transmittance), _or(normals, color), _or(moments, color), ends,
        )  # fmt: skip
        needed = total.wait()
        if needed <= room:
            break
        room = needed
    return Frame(
        g, camera, labels, color, transmittance, weight, depth, median, normals, moments, splats, tilts, view, lists,
        ends,
    )  # fmt: skip


def _or(plane: torch.Tensor | None, stand_in: torch.Tensor) -> torch.Tensor:
    """A kernel takes something of the same kind for what it was compiled not to touch."""
    return stand_in if plane is None else plane


def _drawn(splats, tilts, ids, labels) -> tuple[torch.Tensor, ...]:
    """What the kernels draw, with an element at least in every tensor."""
    if not splats.shape[0]:
        splats = splats.new_empty((1, SPLAT_COLUMNS))
        tilts, ids = splats, ids.new_empty(1)
    return splats, _or(tilts, splats), ids, _or(labels, ids.view(1, -1))


def backward(
    frame: Frame,
    g_color: torch.Tensor,
    g_alpha: torch.Tensor,
    g_weight: torch.Tensor | None = None,
    g_depth: torch.Tensor | None = None,
    g_normals: torch.Tensor | None = None,
    g_moments: torch.Tensor | None = None,
) -> Gaussians:
    """Gradients of a frame's Gaussians from those of its planes; as `cpu.backward`."""
    g = frame.gaussians
    flat = frame.tilts is not None
    count = g.means.shape[0]
    wanted = Wanted(
        flat, frame.labels is not None and g_weight is not None, frame.depth is not None and g_depth is not None, False,
        frame.normals is not None and g_normals is not None, frame.moments is not None and g_moments is not None,
    )  # fmt: skip
    lists, plane = frame.lists, frame.transmittance
    columns, lines = grid(frame.camera.width, frame.camera.height)
    rows = g.means.new_empty((lists.room, GRADIENT_COLUMNS * (2 if wanted.normals else 1)))
    launch(
        blend_backward_kernel(wanted), columns * lines, THREADS,
        *_drawn(frame.splats, frame.tilts, g.ids, frame.labels), lists.starts, lists.members, lists.places, frame.ends,
        np.int32(columns), frame.color, plane, _or(frame.weight, plane), _or(frame.depth, plane),
        _or(frame.normals, frame.color), _or(frame.moments, frame.color), g_color, g_alpha, _or(g_weight, plane),
        _or(g_depth, plane), _or(g_normals, frame.color), _or(g_moments, frame.color), rows,
    )  # fmt: skip
    out = Gaussians(
        torch.empty_like(g.means), torch.empty_like(g.quats), torch.empty_like(g.scales),
        torch.empty_like(g.opacities), torch.empty_like(g.sh), g.ids.new_empty(0),
    )  # fmt: skip
    frame.screen_gradient = g.means.new_empty((count, 2))
    kernel = project_backward_kernel(flat, gradient_columns(flat, wanted.normals))
    launch(
        kernel, -(-count // SPLATS_A_BLOCK), SPLATS_A_BLOCK, g.means, g.quats, g.scales, g.opacities, g.sh, frame.view,
        frame.splats, _or(frame.tilts, frame.splats), lists.firsts, lists.lasts, rows,
        out.means, out.quats, out.scales, out.opacities, out.sh, frame.screen_gradient,
    )  # fmt: skip
    return out


def object_ranks(frame: Frame, ranks: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The most probable IDs of each pixel (ranks, H, W) int32, from the most probable down, -1 where there are no more,
    and their probabilities (ranks, H, W)."""
    best_weight = frame.transmittance.new_zeros((ranks, *frame.transmittance.shape))
    best_id = torch.full_like(best_weight, -1, dtype=torch.int32)
    splats, tilts, ids, _ = _drawn(frame.splats, frame.tilts, frame.gaussians.ids, None)
    columns, _ = grid(frame.camera.width, frame.camera.height)
    most_probable(
        splats, None if frame.tilts is None else tilts, ids, frame.lists, frame.ends, columns, best_id, best_weight
    )
    return best_id, best_weight
