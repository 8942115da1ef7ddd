"""One interface to every renderer: Gaussians, a camera and what is wanted -> what was wanted, differentiable."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch

from . import cpu
from .camera import Camera
from .cpu import compile_kernels

__all__ = ["Camera", "Rendered", "compile_kernels", "object_map", "rasterize"]


class Rendered(NamedTuple):
    """color (3, H, W) premultiplied, without background; alpha (H, W); weight (H, W): probability of the pixel's label;
    depth (H, W): expected depth times alpha; median (H, W): the depth at which half of the light is taken, 0 where less
    is, without gradient; frame: the renderer's own record, for `object_map` and growth. None: not asked for."""

    color: torch.Tensor
    alpha: torch.Tensor
    weight: torch.Tensor | None
    depth: torch.Tensor | None
    median: torch.Tensor | None
    frame: cpu.Frame


def _array(tensor: torch.Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().numpy(), np.float32)


def _tensor(array: np.ndarray | None) -> torch.Tensor | None:
    return None if array is None else torch.from_numpy(array)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means, quats, scales, opacities, sh, ids, camera, labels, want_depth, want_median, holder):
        ctx.means_type = means.dtype
        if means.dtype == torch.float64:
            # Far from the origin (georeferenced captures) float32 would round positions: count from the camera.
            means = means - torch.from_numpy(camera.centre)
            camera = camera.at_origin()
        gaussians = cpu.Gaussians(
            _array(means), _array(quats), _array(scales), _array(opacities), _array(sh),
            np.ascontiguousarray(ids.numpy(), np.int32),
        )  # fmt: skip
        wanted = None if labels is None else np.ascontiguousarray(labels.numpy(), np.int32)
        frame = cpu.forward(gaussians, camera, wanted, want_depth, want_median)
        ctx.frame = frame
        holder.append(frame)
        median = _tensor(frame.median)
        if median is not None:
            ctx.mark_non_differentiable(median)
        alpha = torch.from_numpy(1.0 - frame.transmittance)
        return torch.from_numpy(frame.color), alpha, _tensor(frame.weight), _tensor(frame.depth), median

    @staticmethod
    def backward(ctx: Any, *gradients):
        g_color, g_alpha, g_weight, g_depth = (None if g is None else _array(g) for g in gradients[:4])
        out = cpu.backward(ctx.frame, g_color, g_alpha, g_weight, g_depth)
        arrays = (out.means, out.quats, out.scales, out.opacities, out.sh)
        g_means, *others = (torch.from_numpy(a) for a in arrays)
        return (g_means.to(ctx.means_type), *others, None, None, None, None, None, None)


def rasterize(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    sh: torch.Tensor,
    ids: torch.Tensor,
    camera: Camera,
    labels: torch.Tensor | None = None,
    want_depth: bool = False,
    want_median: bool = False,
) -> Rendered:
    """Draw 3D Gaussians (Kerbl et al. 2023), differentiable in the first five arguments.

    means (N, 3), quats (N, 4) wxyz of any length, scales (N, 3) linear, opacities (N,) in (0, 1), sh (N, K, 3) with
    K = 1, 4, 9 or 16 (colour = 0.5 + SH, clamped at 0): float32. Means in float64 are taken relative to the camera
    before they are rounded, for scenes far from the origin. ids (N,) int32. labels (H, W) int32: also return the
    probability that each pixel shows its label (the paper's P at the label); nothing is computed that is not asked for.
    """
    holder: list[cpu.Frame] = []
    planes = _Rasterize.apply(
        means, quats, scales, opacities, sh, ids, camera, labels, want_depth, want_median, holder
    )  # fmt: skip
    return Rendered(*planes, holder[0])


def object_map(rendered: Rendered) -> tuple[np.ndarray, np.ndarray]:
    """The most probable ID (H, W) int32 (-1 where nothing is drawn) and its probability (H, W) float32."""
    return cpu.object_map(rendered.frame)
