"""The losses of `on_cpu` as GPU kernels with the same values and gradients, without synchronization."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from ...gpu.kernel import kernel

_TILE, _BLOCK = 16, 256
"""Width and height in pixels of the tile that a block of the image loss processes; threads per block of other sums."""


class _ImageLoss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        color: torch.Tensor,
        alpha: torch.Tensor,
        label_probability: torch.Tensor | None,
        background: torch.Tensor,
        target: torch.Tensor,
        labels: torch.Tensor | None,
        ssim_weight: float,
        semantic_weight: float,
        more_labels: torch.Tensor | None,
        window: np.ndarray,
        floor: float,
    ) -> torch.Tensor:
        if label_probability is None:
            labels = None
        height, width = alpha.shape
        blocks = math.ceil(width / _TILE) * math.ceil(height / _TILE)
        has_ssim = ssim_weight > 0
        taps = f"{{{', '.join(f'{float(tap)!r}f' for tap in window)}}}"
        ctx.variant = {"SSIM": has_ssim, "WINDOW": taps, "FLOOR": floor}
        planes = color.new_empty((9, height, width)) if has_ssim else None
        sums, result = color.new_empty((blocks, 4)), color.new_empty(2)
        images = (color.contiguous(), alpha, label_probability, background.contiguous(), target, labels)
        kernel("image_loss", **ctx.variant)(blocks, _TILE**2, *images, width, height, planes, sums)
        kernel("image_loss_total", SSIM=has_ssim)(
            1, _BLOCK, sums, blocks, 3 * height * width, ssim_weight, semantic_weight, more_labels, result
        )
        ctx.save = (images, planes, result, ssim_weight, semantic_weight, more_labels, blocks)
        return result[0]

    @staticmethod
    def backward(ctx: Any, g: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        images, planes, result, ssim_weight, semantic_weight, more_labels, blocks = ctx.save
        color, alpha, _, background, _, labels = images
        height, width = alpha.shape
        g_color, g_alpha, g_background = torch.empty_like(color), torch.empty_like(alpha), torch.empty_like(background)
        g_label_probability = None if labels is None else torch.empty_like(alpha)
        sums = color.new_empty((blocks, 3))
        kernel("image_loss_backward", **ctx.variant)(
            blocks, _TILE**2, *images, planes, result, g.contiguous(), width, height, ssim_weight, semantic_weight,
            more_labels, g_color, g_alpha, g_label_probability, sums,
        )  # fmt: skip
        kernel("totals")(3, _BLOCK, sums, blocks, 3, 1.0, g_background)
        return g_color, g_alpha, g_label_probability, g_background, *[None] * 7


def image_loss(
    color: torch.Tensor,
    alpha: torch.Tensor,
    label_probability: torch.Tensor | None,
    background: torch.Tensor,
    target: torch.Tensor,
    labels: torch.Tensor | None,
    ssim_weight: float,
    semantic_weight: float | torch.Tensor,
    window: np.ndarray,
    floor: float,
) -> torch.Tensor:
    """Compute `on_cpu.image_loss`, differentiable in color, alpha, label_probability and background.

    window: (11,) float32, the window of SSIM; floor: added to the probability in the logarithm.
    """
    weight, more_labels = 1.0, None
    if isinstance(semantic_weight, torch.Tensor):
        more_labels = semantic_weight.detach()
    else:
        weight = semantic_weight
    return _ImageLoss.apply(
        color, alpha, label_probability, background, target, labels, ssim_weight, weight, more_labels, window, floor
    )


class _VolumeLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, scales: torch.Tensor, flat: bool, valid: torch.Tensor | None) -> torch.Tensor:
        blocks = math.ceil(len(scales) / _BLOCK)
        sums, mean = scales.new_empty((blocks, 2)), scales.new_empty(2)
        kernel("volume", FLAT=flat)(blocks, _BLOCK, scales, valid, len(scales), sums)
        kernel("volume_mean")(1, _BLOCK, sums, blocks, mean)
        ctx.save = scales, flat, valid, mean
        return mean[0]

    @staticmethod
    def backward(ctx: Any, g: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        scales, flat, valid, mean = ctx.save
        g_scales = torch.empty_like(scales)
        kernel("volume_backward", FLAT=flat).for_each(
            len(scales), scales, valid, mean, g.contiguous(), len(scales), g_scales
        )
        return g_scales, None, None


def volume_loss(scales: torch.Tensor, flat: bool, valid: torch.Tensor | None) -> torch.Tensor:
    """Compute `on_cpu.volume_loss`, differentiable in scales."""
    return _VolumeLoss.apply(scales.contiguous(), flat, valid)


class _NormalLoss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, normals: torch.Tensor, depth: torch.Tensor, alpha: torch.Tensor, intrinsics: np.ndarray,
        solid: float, grazing: float,
    ) -> torch.Tensor:  # fmt: skip
        height, width = alpha.shape
        blocks = math.ceil(height * width / _BLOCK)
        camera = (*(float(value) for value in intrinsics), width, height)
        partial, sums, mean = alpha.new_empty((9, height, width)), alpha.new_empty(blocks), alpha.new_empty(1)
        kernel("normal_loss", SOLID=solid, GRAZING=grazing)(
            blocks, _BLOCK, normals, depth, alpha, *camera, partial, sums
        )
        kernel("totals")(1, _BLOCK, sums, blocks, 1, 1 / (height * width), mean)
        ctx.save = depth, alpha, partial, camera
        return mean[0]

    @staticmethod
    def backward(ctx: Any, g: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        depth, alpha, partial, camera = ctx.save
        g_normals, g_depth, g_alpha = (
            alpha.new_empty((3, *alpha.shape)),
            torch.empty_like(depth),
            torch.empty_like(alpha),
        )
        kernel("normal_loss_backward").for_each(
            alpha.numel(), depth, alpha, partial, g.contiguous(), *camera, g_normals, g_depth, g_alpha
        )
        return g_normals, g_depth, g_alpha, None, None, None


def normal_loss(
    normals: torch.Tensor,
    depth: torch.Tensor,
    alpha: torch.Tensor,
    intrinsics: np.ndarray,
    solid: float,
    grazing: float,
) -> torch.Tensor:
    """Compute `on_cpu.normal_loss`, differentiable in the first three arguments.

    solid: smallest alpha of a pixel with a depth; grazing: smallest cosine between ray and normal.
    """
    return _NormalLoss.apply(normals, depth, alpha, intrinsics, solid, grazing)
