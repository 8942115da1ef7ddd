"""The readable renderer: plain torch in any float type, differentiable by autograd, the oracle for all others.

Every splat is blended into every pixel in one depth order, without tiles; slow, and meant for tests.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch

from .camera import Camera
from .settings import ALPHA_MAX, ALPHA_MIN, BLUR, MAX_EXTENT, MIN_QUAT_NORM2, STOP, TAN_MARGIN


class ReferencePicture(NamedTuple):
    """color (3, H, W), alpha, depth and median (H, W) as in `Rendered`; probabilities (H, W, n), one channel an ID."""

    color: torch.Tensor
    alpha: torch.Tensor
    depth: torch.Tensor
    median: torch.Tensor
    probabilities: torch.Tensor


def rotation_matrices(quats: torch.Tensor) -> torch.Tensor:
    """(N, 4) wxyz, unit -> (N, 3, 3)."""
    w, x, y, z = quats.unbind(-1)
    return torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ],
        -1,
    ).reshape(*quats.shape[:-1], 3, 3)  # fmt: skip


def sh_colors(sh: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """(N, K, 3) coefficients and (N, 3) unit directions -> (N, 3): 0.5 + sum of real SH, clamped at 0."""
    x, y, z = directions.unbind(-1)
    one = torch.ones_like(x)
    basis = [one / (2 * math.sqrt(math.pi))]
    if sh.shape[1] > 1:
        k = math.sqrt(3 / (4 * math.pi))
        basis += [-k * y, k * z, -k * x]
    if sh.shape[1] > 4:
        k = math.sqrt(15 / (4 * math.pi))
        basis += [k * x * y, -k * y * z, math.sqrt(5 / (16 * math.pi)) * (2 * z * z - x * x - y * y), -k * x * z]
        basis += [k / 2 * (x * x - y * y)]
    if sh.shape[1] > 9:
        a, b, c = (math.sqrt(v / math.pi) for v in (35 / 32, 105 / 4, 21 / 32))
        basis += [-a * y * (3 * x * x - y * y), b * x * y * z, -c * y * (4 * z * z - x * x - y * y)]
        basis += [math.sqrt(7 / (16 * math.pi)) * z * (2 * z * z - 3 * x * x - 3 * y * y)]
        basis += [-c * x * (4 * z * z - x * x - y * y), b / 2 * z * (x * x - y * y), -a * x * (x * x - 3 * y * y)]
    return torch.clamp(0.5 + (torch.stack(basis, -1)[:, :, None] * sh).sum(1), min=0)


def rasterize_reference(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    sh: torch.Tensor,
    ids: torch.Tensor,
    camera: Camera,
    objects: int = 1,
) -> ReferencePicture:
    """Draw 3D Gaussians; shapes as in `backend.raster.rasterize`, ids in 0 .. objects - 1."""
    dtype = means.dtype
    height, width = camera.height, camera.width
    viewmat = torch.as_tensor(camera.viewmat, dtype=torch.float64).to(dtype)
    fx, fy, cx, cy = (float(v) for v in camera.arrays()[1])
    W, t = viewmat[:3, :3], viewmat[:3, 3]
    eye = -(W.T @ t)
    # Splats that the guards drop are left out before any division, so that no NaN gradient passes a mask.
    z = (means @ W.T + t)[:, 2]
    kept = (
        (z > camera.near) & (opacities > ALPHA_MIN) & torch.isfinite(opacities) & ((quats**2).sum(-1) > MIN_QUAT_NORM2)
    )
    for values in (means, quats, scales, sh.flatten(1)):
        kept &= torch.isfinite(values).all(-1)
    means, quats, scales, opacities, sh, ids = (v[kept] for v in (means, quats, scales, opacities, sh, ids))

    p = means @ W.T + t
    x, y, z = p.unbind(-1)
    u, v = fx * x / z + cx, fy * y / z + cy
    tx = torch.clamp(x / z, -cx / fx - TAN_MARGIN * 0.5 * width / fx, (width - cx) / fx + TAN_MARGIN * 0.5 * width / fx)
    ty = torch.clamp(
        y / z, -cy / fy - TAN_MARGIN * 0.5 * height / fy, (height - cy) / fy + TAN_MARGIN * 0.5 * height / fy
    )
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * tx / z, zero, fy / z, -fy * ty / z], -1).reshape(-1, 2, 3)
    R = rotation_matrices(quats / torch.linalg.vector_norm(quats, dim=-1, keepdim=True))
    M = J @ W @ R * scales[:, None, :]
    cov = M @ M.transpose(1, 2) + BLUR * torch.eye(2, dtype=dtype)
    a, b, c = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    # a - b^2 / c, where a c - b^2 without the blur is the squared area that M's rows span.
    area2 = (torch.linalg.cross(M[:, 0], M[:, 1], dim=-1) ** 2).sum(-1)
    conditional = (area2 + BLUR * (a + c - BLUR)) / c
    extent2 = 2 * torch.log(opacities / ALPHA_MIN) * torch.maximum(a, c)
    directions = means - eye
    colors = sh_colors(sh, directions / torch.linalg.vector_norm(directions, dim=-1, keepdim=True))

    columns = torch.arange(width, dtype=dtype) + 0.5
    lines = torch.arange(height, dtype=dtype) + 0.5
    T = torch.ones(height, width, dtype=dtype)
    color = torch.zeros(3, height, width, dtype=dtype)
    depth = torch.zeros(height, width, dtype=dtype)
    median = torch.zeros(height, width, dtype=dtype)
    probabilities = torch.zeros(height, width, objects, dtype=dtype)
    for n in torch.argsort(z.detach(), stable=True).tolist():
        if not extent2[n] < MAX_EXTENT**2:
            continue
        dy = (lines - v[n])[:, None]
        d = columns[None, :] - u[n] - b[n] / c[n] * dy
        power = 0.5 * (d * d / conditional[n] + dy * dy / c[n])
        raw = opacities[n] * torch.exp(-power)
        drawn = (raw >= ALPHA_MIN) & (T >= STOP)
        alpha = torch.where(drawn, torch.clamp(raw, max=ALPHA_MAX), torch.zeros_like(raw))
        w = alpha * T
        color = color + w * colors[n][:, None, None]
        depth = depth + w * z[n]
        channel = torch.zeros(objects, dtype=dtype)
        channel[int(ids[n])] = 1
        probabilities = probabilities + w[..., None] * channel
        after = T * (1 - alpha)
        median = torch.where((T.detach() >= 0.5) & (after.detach() < 0.5), z[n].detach(), median)
        T = after
    return ReferencePicture(color, 1 - T, depth, median, probabilities)
