"""The losses of `on_cpu` as torch operations with the same values and gradients, without synchronization."""

from __future__ import annotations

import numpy as np
import torch

from ...raster import devices

Gradients = tuple[torch.Tensor, torch.Tensor, torch.Tensor | None, torch.Tensor]


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
) -> tuple[torch.Tensor, Gradients]:
    """Compute `on_cpu.image_loss` and its gradients with respect to color, alpha, label_probability and background.

    window: (11,) float32, the window of SSIM; floor: added to the probability in the logarithm.
    """
    behind = background[:, None, None]
    image = color + (1 - alpha) * behind
    difference = image - target
    loss = (1 - ssim_weight) * difference.abs().mean()
    g_image = difference.sign().mul_((1 - ssim_weight) / difference.numel())
    if ssim_weight:
        ssim, g_ssim = ssim_and_gradient(image, target, window)
        loss = loss + ssim_weight * (1 - ssim)
        g_image.sub_(g_ssim, alpha=ssim_weight)
    g_label_probability = None
    if label_probability is not None and labels is not None:
        labeled = labels >= 0
        count = labeled.sum().clamp(min=1)
        semantic = torch.where(labeled, -torch.log((label_probability + floor) / (1 + floor)), 0.0).sum() / count
        loss = loss + semantic_weight * semantic
        g_label_probability = torch.where(labeled, -semantic_weight / (count * (label_probability + floor)), 0.0)
    return loss, (g_image, -(g_image * behind).sum(0), g_label_probability, (g_image * (1 - alpha)).sum((1, 2)))


def ssim_and_gradient(
    image: torch.Tensor, target: torch.Tensor, window: np.ndarray
) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute the mean SSIM of image and target (3, H, W), and its gradient (3, H, W) with respect to the image."""
    taps = devices.upload(window, image)
    moments = torch.stack([image, target, image * image, target * target, image * target])
    mu1, mu2, square1, square2, product = _blur(moments, taps)
    s11, s22, s12 = square1 - mu1 * mu1, square2 - mu2 * mu2, product - mu1 * mu2
    c1, c2 = 0.01**2, 0.03**2
    a, b = 2 * mu1 * mu2 + c1, 2 * s12 + c2
    over_d, over_e = 1 / (mu1 * mu1 + mu2 * mu2 + c1), 1 / (s11 + s22 + c2)
    value = a * b * over_d * over_e
    # Gradients with respect to the blurred square of the image and the blurred product with the target.
    g_square = -value * over_e
    g_product = 2 * a * over_d * over_e
    g_mean = 2 * over_d * (mu2 * b * over_e - mu1 * value) - 2 * mu1 * g_square - mu2 * g_product
    back = _blur(torch.stack([g_mean, g_square, g_product]) / image.numel(), taps)
    return value.mean(), back[0] + 2 * image * back[1] + target * back[2]


def _blur(planes: torch.Tensor, taps: torch.Tensor) -> torch.Tensor:
    """Convolve planes (n, 3, H, W) with the window along rows and columns, with zero padding."""
    n, channels, height, width = planes.shape
    count, radius = n * channels, len(taps) // 2
    # A depthwise convolution uses torch's own kernel in full float32; variances are small differences of large numbers.
    across = taps.view(1, 1, 1, -1).expand(count, 1, 1, -1)
    down = taps.view(1, 1, -1, 1).expand(count, 1, -1, 1)
    out = torch.conv2d(planes.view(1, count, height, width), across, padding=(0, radius), groups=count)
    return torch.conv2d(out, down, padding=(radius, 0), groups=count).view(planes.shape)


def volume_loss(scales: torch.Tensor, flat: bool, valid: torch.Tensor | None) -> torch.Tensor:
    """Compute `on_cpu.volume_loss`, differentiable in scales."""
    a, b, c = scales.unbind(1)
    size = a * b if flat else a * b * c
    return size.mean() if valid is None else torch.where(valid, size, 0.0).sum() / valid.sum().clamp(min=1)


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
    height, width = alpha.shape
    if height < 3 or width < 3:
        return 0.0 * (normals.sum() + depth.sum() + alpha.sum())
    fx, fy, cx, cy = (float(v) for v in intrinsics)
    rx = (torch.arange(1, width - 1, device=alpha.device) + (0.5 - cx)) / fx
    ry = ((torch.arange(1, height - 1, device=alpha.device) + (0.5 - cy)) / fy)[:, None]
    drawn = alpha > 0
    z = torch.where(drawn, depth / torch.where(drawn, alpha, 1.0), 0.0)
    left, right, above, below = z[1:-1, :-2], z[1:-1, 2:], z[:-2, 1:-1], z[2:, 1:-1]
    az, bz = right - left, below - above
    ax, ay = rx * az + (right + left) / fx, ry * az
    bx, by = rx * bz, ry * bz + (below + above) / fy
    nx, ny, nz = by * az - ay * bz, ax * bz - bx * az, ay * bx - ax * by
    square = nx * nx + ny * ny + nz * nz
    length = torch.where(square > 0, square, 1.0).sqrt()
    nx, ny, nz = nx / length, ny / length, nz / length
    middle = alpha[1:-1, 1:-1]
    least = torch.minimum(
        torch.minimum(alpha[1:-1, :-2], alpha[1:-1, 2:]), torch.minimum(alpha[:-2, 1:-1], alpha[2:, 1:-1])
    )
    faces = -(nx * rx + ny * ry + nz) > grazing * (rx * rx + ry * ry + 1.0).sqrt()
    counted = (torch.minimum(least, middle) > solid) & (square > 0) & faces
    mx, my, mz = normals[:, 1:-1, 1:-1]
    return torch.where(counted, middle - (mx * nx + my * ny + mz * nz), 0.0).sum() / (height * width)
