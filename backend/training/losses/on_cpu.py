"""The loss of a view with hand-written gradients: L1, SSIM and the probability of the labels.

L = (1 - lambda_ssim) L1 + lambda_ssim (1 - SSIM) - lambda_semantic mean log((P_label + f) / (1 + f)), for the composed
image color + (1 - alpha) background, with f = PROBABILITY_FLOOR. It follows ObjectGS equations 7 and 8, where L1 is not
weighted, the logarithm is summed over the pixels, and f is 0. SSIM is that of Wang et al. 2004 with an 11 x 11 Gaussian
of sigma 1.5 and zero padding.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numba import njit, prange

from ...raster import devices, simd
from ...raster.kernel import kernel
from . import on_gpu as losses_on_gpu

_RADIUS = 5
_C1 = 0.01**2
_C2 = 0.03**2
_WINDOW = np.exp(-0.5 * (np.arange(-_RADIUS, _RADIUS + 1) / 1.5) ** 2)
_WINDOW = (_WINDOW / _WINDOW.sum()).astype(np.float32)
PROBABILITY_FLOOR = 1e-2
"""Added to P in the logarithm, to bound the gradient of pixels whose object is not rendered there."""

_SOLID = 0.5
"""Smallest alpha of pixels whose depth is used to compute a normal."""

_GRAZING = 0.1
"""Cosine between ray and normal below which the depth is considered discontinuous."""

# Allow reordering of sums, so that they vectorize; NaN must still propagate.
_REORDER = {"reassoc", "contract", "nsz"}


@njit(inline="always", error_model="numpy")
def _blur_row(source, window, out, width):
    """Write out[x] = sum_k window[k] source[x + k]; source is padded by the window's radius."""
    for x in range(0, width, simd.LANES):
        acc = simd.splat(window[0]) * simd.load(source, x)
        for k in range(1, 2 * _RADIUS + 1):
            acc = acc + simd.splat(window[k]) * simd.load(source, x + k)
        simd.store(out, x, acc)


@njit(inline="always", error_model="numpy")
def _add_row(weight, source, at, out, width):
    w = simd.splat(weight)
    for x in range(0, width, simd.LANES):
        simd.store(out, x, simd.load(out, x) + w * simd.load(source, at + x))


@kernel(parallel=True, fastmath=_REORDER)
def ssim_gradient(image, target, window, gradient):
    """Return the mean SSIM of image and target (3, H, W), and write its gradient (3, H, W) with respect to image."""
    channels, height, width = image.shape
    stride = (width + simd.LANES - 1) // simd.LANES * simd.LANES
    blurred = np.empty(channels * height * 5 * stride, np.float32)
    partial = np.empty(channels * height * 3 * stride, np.float32)
    sums = np.zeros(channels * height)
    scale = np.float32(1.0 / (channels * height * width))
    for line in prange(channels * height):
        c, y = line // height, line % height
        padded = np.zeros(stride + 2 * _RADIUS + simd.LANES, np.float32)
        row = np.empty(stride, np.float32)
        shown, wanted = image[c, y], target[c, y]
        for moment in range(5):
            left = shown if moment in (0, 2, 4) else wanted
            right = shown if moment == 2 else wanted
            if moment < 2:
                for x in range(width):
                    padded[x + _RADIUS] = left[x]
            else:
                for x in range(width):
                    padded[x + _RADIUS] = left[x] * right[x]
            _blur_row(padded, window, row, width)
            base = (line * 5 + moment) * stride
            for x in range(stride):
                blurred[base + x] = row[x]
    for line in prange(channels * height):
        c, y = line // height, line % height
        m = np.zeros((5, stride), np.float32)
        for moment in range(5):
            for k in range(max(-_RADIUS, -y), min(_RADIUS + 1, height - y)):
                _add_row(window[k + _RADIUS], blurred, ((line + k) * 5 + moment) * stride, m[moment], width)
        padded = np.zeros(stride + 2 * _RADIUS + simd.LANES, np.float32)
        rows = np.empty((3, stride), np.float32)
        total = np.float32(0.0)
        for x in range(width):
            mu1, mu2 = m[0, x], m[1, x]
            s11, s22, s12 = m[2, x] - mu1 * mu1, m[3, x] - mu2 * mu2, m[4, x] - mu1 * mu2
            a = 2 * mu1 * mu2 + np.float32(_C1)
            b = 2 * s12 + np.float32(_C2)
            d = mu1 * mu1 + mu2 * mu2 + np.float32(_C1)
            e = s11 + s22 + np.float32(_C2)
            over_d, over_e = np.float32(1.0) / d, np.float32(1.0) / e
            value = a * b * over_d * over_e
            total += value
            # Derivatives with respect to blurred x, blurred x^2 and blurred x y.
            g11 = -value * over_e
            g12 = 2 * a * over_d * over_e
            rows[0, x] = (2 * mu2 * b * over_d * over_e - 2 * mu1 * value * over_d - 2 * mu1 * g11 - mu2 * g12) * scale
            rows[1, x] = g11 * scale
            rows[2, x] = g12 * scale
        sums[line] = total
        row = np.empty(stride, np.float32)
        for i in range(3):
            for x in range(width):
                padded[x + _RADIUS] = rows[i, x]
            _blur_row(padded, window, row, width)
            base = (line * 3 + i) * stride
            for x in range(stride):
                partial[base + x] = row[x]
    for line in prange(channels * height):
        c, y = line // height, line % height
        m = np.zeros((3, stride), np.float32)
        for i in range(3):
            for k in range(max(-_RADIUS, -y), min(_RADIUS + 1, height - y)):
                _add_row(window[k + _RADIUS], partial, ((line + k) * 3 + i) * stride, m[i], width)
        for x in range(width):
            gradient[c, y, x] = m[0, x] + 2 * image[c, y, x] * m[1, x] + target[c, y, x] * m[2, x]
    return sums.sum() * float(scale)


@kernel(parallel=True, fastmath=_REORDER)
def _compose(color, alpha, background, target, image):
    """Write image = color + (1 - alpha) background; returns mean |image - target|."""
    _, height, width = color.shape
    sums = np.zeros(height)
    for y in prange(height):
        total = np.float32(0.0)
        for c in range(3):
            for x in range(width):
                value = color[c, y, x] + (1 - alpha[y, x]) * background[c]
                image[c, y, x] = value
                total += abs(value - target[c, y, x])
        sums[y] = total
    return sums.sum() / (3.0 * height * width)


@kernel(parallel=True, fastmath=_REORDER)
def _image_gradient(image, target, alpha, background, g_ssim, l1_weight, ssim_weight, g_color, g_alpha, g_background):
    _, height, width = image.shape
    step = np.float32(l1_weight / (3.0 * height * width))
    ssim_weight = np.float32(ssim_weight)
    partial = np.zeros((height, 3))
    for y in prange(height):
        for x in range(width):
            g_alpha[y, x] = 0.0
        for c in range(3):
            total = np.float32(0.0)
            for x in range(width):
                difference = image[c, y, x] - target[c, y, x]
                g = step if difference > 0 else (-step if difference < 0 else np.float32(0.0))
                g -= ssim_weight * g_ssim[c, y, x]
                g_color[c, y, x] = g
                g_alpha[y, x] -= g * background[c]
                total += g * (1 - alpha[y, x])
            partial[y, c] = total
    for c in range(3):
        g_background[c] = partial[:, c].sum()


@kernel(parallel=True)
def _label_loss(label_probability, labels, floor, scale, g_label_probability):
    """Return -mean log((P + floor) / (1 + floor)) over pixels with a label >= 0; writes its gradient times `scale`."""
    height, width = label_probability.shape
    counts = np.zeros(height, np.int64)
    sums = np.zeros(height)
    for y in prange(height):
        for x in range(width):
            if labels[y, x] >= 0:
                counts[y] += 1
                sums[y] -= math.log((label_probability[y, x] + floor) / (1.0 + floor))
    count = max(counts.sum(), 1)
    for y in prange(height):
        for x in range(width):
            if labels[y, x] >= 0:
                g_label_probability[y, x] = -scale / (count * (label_probability[y, x] + floor))
            else:
                g_label_probability[y, x] = 0.0
    return sums.sum() / count


class _ImageLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, color, alpha, label_probability, background, target, labels, ssim_weight, semantic_weight):
        arrays = [t.detach().numpy() for t in (color, alpha, background)]
        shown = target.numpy()
        image = np.empty_like(shown)
        l1 = _compose(arrays[0], arrays[1], arrays[2], shown, image)
        g_ssim = np.empty_like(shown)
        ssim = ssim_gradient(image, shown, _WINDOW, g_ssim) if ssim_weight else 1.0
        if not ssim_weight:
            g_ssim[:] = 0
        g_color, g_alpha, g_background = np.empty_like(shown), np.empty_like(arrays[1]), np.empty(3, np.float32)
        _image_gradient(
            image, shown, arrays[1], arrays[2], g_ssim, 1 - ssim_weight, ssim_weight, g_color, g_alpha, g_background
        )
        semantic = 0.0
        g_label_probability = None
        if label_probability is not None:
            g_label_probability = np.empty_like(arrays[1])
            semantic = _label_loss(
                label_probability.detach().numpy(),
                labels.numpy(),
                PROBABILITY_FLOOR,
                semantic_weight,
                g_label_probability,
            )
        ctx.gradients = tuple(
            None if a is None else torch.from_numpy(a) for a in (g_color, g_alpha, g_label_probability, g_background)
        )
        loss = (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim) + semantic_weight * semantic
        return torch.tensor(loss, dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, g):
        scaled = [None if a is None else a * g for a in ctx.gradients]
        return (*scaled, None, None, None, None)


@kernel(parallel=True, fastmath=_REORDER)
def _volumes(scales, flat, gradient):
    """Return the mean product of the rows of scales (N, 3), or of their first two columns if `flat`.

    Writes its gradient to `gradient`.
    """
    n = scales.shape[0]
    chunks = (n + 1023) // 1024
    sums = np.zeros(chunks)
    per_splat = np.float32(1.0 / n)
    for chunk in prange(chunks):
        total = np.float32(0.0)
        for i in range(chunk * 1024, min(chunk * 1024 + 1024, n)):
            a, b, c = scales[i, 0], scales[i, 1], np.float32(1.0) if flat else scales[i, 2]
            gradient[i, 0] = b * c * per_splat
            gradient[i, 1] = a * c * per_splat
            gradient[i, 2] = np.float32(0.0) if flat else a * b * per_splat
            total += a * b * c
        sums[chunk] = total
    return sums.sum() / n


class _VolumeLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, scales, flat):
        ctx.gradient = np.empty(tuple(scales.shape), np.float32)
        return torch.tensor(_volumes(scales.detach().numpy(), flat, ctx.gradient), dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, g):
        return torch.from_numpy(ctx.gradient) * g, None


def volume_loss(scales: torch.Tensor, flat: bool = False, valid: torch.Tensor | None = None) -> torch.Tensor:
    """Compute the mean volume of the splats, i.e. the product of their scales (Scaffold-GS equation 9, as a mean).

    Args:
        scales: (N, 3), N > 0.
        flat: whether the splats are discs, for which the mean area is computed.
        valid: (N,) bool, only on the GPU: the entries that are splats.

    Returns:
        () float32.
    """
    if devices.on_gpu(scales):
        return losses_on_gpu.volume_loss(scales, flat, valid)
    return _VolumeLoss.apply(scales, flat)


@kernel(parallel=True)
def _normal_sums(normals, depth, alpha, intrinsics, partial):
    """Sum alpha - normals . N over the pixels for which the depth has a normal N.

    N is perpendicular to the difference of the left and right neighbors' points, and to that of the upper and lower
    ones. partial (9, H, W) receives the sum's gradient with respect to the two differences, then N; 0 where there is
    none.
    """
    height, width = alpha.shape
    sums = np.zeros(height)
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for y in prange(height):
        for x in range(width):
            for i in range(9):
                partial[i, y, x] = 0.0
            if x == 0 or y == 0 or x == width - 1 or y == height - 1:
                continue
            lowest = min(min(alpha[y, x - 1], alpha[y, x + 1]), min(alpha[y - 1, x], alpha[y + 1, x]))
            if not min(lowest, alpha[y, x]) > _SOLID:
                continue
            rx, ry = (x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy
            left, right = depth[y, x - 1] / alpha[y, x - 1], depth[y, x + 1] / alpha[y, x + 1]
            above, below = depth[y - 1, x] / alpha[y - 1, x], depth[y + 1, x] / alpha[y + 1, x]
            az, bz = right - left, below - above
            ax, ay = rx * az + (right + left) / fx, ry * az
            bx, by = rx * bz, ry * bz + (below + above) / fy
            nx, ny, nz = by * az - ay * bz, ax * bz - bx * az, ay * bx - ax * by
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            if not length > 0.0:
                continue
            nx, ny, nz = nx / length, ny / length, nz / length
            if not -(nx * rx + ny * ry + nz) > _GRAZING * math.sqrt(rx * rx + ry * ry + 1.0):
                continue
            mx, my, mz = normals[0, y, x], normals[1, y, x], normals[2, y, x]
            along = mx * nx + my * ny + mz * nz
            sums[y] += alpha[y, x] - along
            # N = -(a x b) / |a x b|
            gx, gy, gz = (mx - along * nx) / length, (my - along * ny) / length, (mz - along * nz) / length
            partial[0, y, x] = by * gz - bz * gy
            partial[1, y, x] = bz * gx - bx * gz
            partial[2, y, x] = bx * gy - by * gx
            partial[3, y, x] = gy * az - gz * ay
            partial[4, y, x] = gz * ax - gx * az
            partial[5, y, x] = gx * ay - gy * ax
            partial[6, y, x] = nx
            partial[7, y, x] = ny
            partial[8, y, x] = nz
    return sums.sum()


@kernel(parallel=True)
def _normal_gradient(depth, alpha, intrinsics, partial, g_normals, g_depth, g_alpha):
    """Compute the gradient of `_normal_sums`, divided by the number of pixels, for its first three arguments."""
    height, width = alpha.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    per_pixel = 1.0 / (height * width)
    for y in prange(height):
        for x in range(width):
            rx, ry = (x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy
            g = 0.0
            for i in range(3):
                g_point = 0.0
                if x > 0:
                    g_point += partial[i, y, x - 1]
                if x < width - 1:
                    g_point -= partial[i, y, x + 1]
                if y > 0:
                    g_point += partial[3 + i, y - 1, x]
                if y < height - 1:
                    g_point -= partial[3 + i, y + 1, x]
                g += g_point * (rx if i == 0 else ry if i == 1 else 1.0)
                g_normals[i, y, x] = -per_pixel * partial[6 + i, y, x]
            g_covered = 1.0 if partial[6, y, x] != 0.0 or partial[7, y, x] != 0.0 or partial[8, y, x] != 0.0 else 0.0
            g_depth[y, x] = 0.0
            if alpha[y, x] > 0.0 and g != 0.0:
                g_depth[y, x] = per_pixel * g / alpha[y, x]
                g_covered -= g * depth[y, x] / (alpha[y, x] * alpha[y, x])
            g_alpha[y, x] = per_pixel * g_covered


class _NormalLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, normals, depth, alpha, intrinsics):
        arrays = [t.detach().numpy() for t in (normals, depth, alpha)]
        height, width = arrays[2].shape
        partial = np.empty((9, height, width), np.float32)
        value = _normal_sums(*arrays, intrinsics, partial) / (height * width)
        ctx.gradients = tuple(np.empty_like(a) for a in arrays)
        _normal_gradient(*arrays[1:], intrinsics, partial, *ctx.gradients)
        return torch.tensor(value, dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, g):
        return (*(torch.from_numpy(a) * g for a in ctx.gradients), None)


def normal_loss(
    normals: torch.Tensor, depth: torch.Tensor, alpha: torch.Tensor, intrinsics: np.ndarray
) -> torch.Tensor:
    """Compute the normal consistency loss of discs (Huang et al. 2024, "2D Gaussian Splatting", equation 14).

    It is the mean over the pixels of sum_i w_i (1 - n_i . N), where N is the normal computed from the depth. Pixels are
    included if they and their neighbors are covered, and the surface is not at a grazing angle, as it is at depth
    discontinuities.

    Args:
        normals: (3, H, W), as in `Rendered`.
        depth, alpha: (H, W), as in `Rendered`.
        intrinsics: fx, fy, cx, cy in pixels.

    Returns:
        () float32.
    """
    if devices.on_gpu(depth):
        return losses_on_gpu.normal_loss(normals, depth, alpha, intrinsics, _SOLID, _GRAZING)
    return _NormalLoss.apply(normals, depth, alpha, intrinsics)


def image_loss(
    color: torch.Tensor,
    alpha: torch.Tensor,
    label_probability: torch.Tensor | None,
    background: torch.Tensor,
    target: torch.Tensor,
    labels: torch.Tensor | None,
    ssim_weight: float,
    semantic_weight: float | torch.Tensor,
) -> torch.Tensor:
    """Compute the loss of one view as defined in the module's docstring.

    Args:
        color: (3, H, W), rendered.
        alpha: (H, W), rendered.
        label_probability: (H, W), the rendered probability of each pixel's label; None: no label loss.
        background: (3,) RGB.
        target: (3, H, W), the image.
        labels: (H, W) int32; -1 is ignored. None: no label loss.
        ssim_weight: weight of SSIM, 0 .. 1; the weight of L1 is 1 - ssim_weight.
        semantic_weight: weight of the label loss.

    Returns:
        () float32.
    """
    arguments = (color, alpha, label_probability, background, target, labels, ssim_weight, semantic_weight)
    if devices.on_gpu(color):
        return losses_on_gpu.image_loss(*arguments, _WINDOW, PROBABILITY_FLOOR)
    return _ImageLoss.apply(*arguments)
