"""Reference renderer for tests: plain torch in any float type, differentiable by autograd.

It is slow, since each splat is blended into all pixels in a global depth order, without tiles.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch

from .camera import Camera
from .settings import (
    ALPHA_MAX,
    ALPHA_MIN,
    EPS_2D_DISC,
    MAX_EXTENT,
    MIN_DISC_WIDTH,
    MIN_QUAT_NORM2,
    TAN_MARGIN,
    TRANSMITTANCE_THRESHOLD,
)


class ReferenceRender(NamedTuple):
    """An image of the reference renderer.

    color (3, H, W), alpha, depth, median, surface and distortion (H, W), normals (3, H, W; 0 for 3D Gaussians) as in
    `Rendered`; probabilities (H, W, n): one channel per ID.
    """

    color: torch.Tensor
    alpha: torch.Tensor
    depth: torch.Tensor
    median: torch.Tensor
    surface: torch.Tensor
    normals: torch.Tensor
    distortion: torch.Tensor
    probabilities: torch.Tensor


def rotation_matrices(quats: torch.Tensor) -> torch.Tensor:
    """Convert unit quaternions (N, 4) wxyz to rotation matrices (N, 3, 3)."""
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
    """Evaluate SH (N, K, 3) in unit directions (N, 3); returns colors (N, 3) = 0.5 + sum of real SH, clamped at 0."""
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


def _footprints(
    p: torch.Tensor, axes: torch.Tensor, camera: Camera, blur: float, tan_margin: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Project covariances with the Jacobian of the projection: a, b, c (N,) of [[a, b], [b, c]] and a - b^2 / c.

    p (N, 3): centers in camera space; axes (N, 3, 2 or 3): axes scaled by the standard deviations; blur: variance of
    the low-pass filter; tan_margin: margin beyond the image, as a fraction of its half size, at which the direction is
    clamped for the Jacobian.
    """
    fx, fy, cx, cy = (float(v) for v in camera.arrays()[1])
    x, y, z = p.unbind(-1)
    left, top, right, bottom = camera.bounds
    across, down = tan_margin * 0.5 * (right - left), tan_margin * 0.5 * (bottom - top)
    tx = torch.clamp(x / z, (left - across - cx) / fx, (right + across - cx) / fx)
    ty = torch.clamp(y / z, (top - down - cy) / fy, (bottom + down - cy) / fy)
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * tx / z, zero, fy / z, -fy * ty / z], -1).reshape(-1, 2, 3)
    M = J @ axes
    cov = M @ M.transpose(1, 2) + blur * torch.eye(2, dtype=p.dtype)
    a, b, c = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    # a - b^2 / c; without the blur, a c - b^2 is the squared area of the parallelogram spanned by M's rows.
    if axes.shape[-1] == 2:
        area2 = (M[:, 0, 0] * M[:, 1, 1] - M[:, 0, 1] * M[:, 1, 0]) ** 2
    else:
        area2 = (torch.linalg.cross(M[:, 0], M[:, 1], dim=-1) ** 2).sum(-1)
    return a, b, c, (area2 + blur * (a + c - blur)) / c


def _disc_power(
    rays: torch.Tensor, p: torch.Tensor, R: torch.Tensor, scales: torch.Tensor, spot: torch.Tensor, near: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return half the squared distance of each ray (H, W, 3) from a disc's center, and the depth.

    The distance, in standard deviations, is measured at the ray's intersection with the disc's plane or, if smaller, in
    the image (`spot`).
    """
    t1, t2, normal = R.unbind(-1)
    inverse = (rays @ normal) / (p @ normal)
    ahead = (inverse > 0) & (1 / torch.where(inverse > 0, inverse, 1) >= near)
    z = 1 / torch.where(ahead, inverse, 1)
    hit = rays * z[..., None] - p
    power = 0.5 * ((hit @ t1 / scales[0]) ** 2 + (hit @ t2 / scales[1]) ** 2)
    plane = ahead & (power < spot)
    return torch.where(plane, power, spot), torch.where(plane, z, p[2])


def rasterize_reference(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    sh: torch.Tensor,
    ids: torch.Tensor,
    camera: Camera,
    objects: int = 1,
    primitive: str = "3d",
) -> ReferenceRender:
    """Render 3D Gaussians or discs.

    Args:
        means, quats, scales, opacities, sh, camera, primitive: as in `backend.raster.rasterize`.
        ids: (N,) in 0 .. objects - 1.
        objects: number of IDs.

    Returns:
        The image, in the float type of means.
    """
    dtype = means.dtype
    flat = primitive == "2d"
    height, width = camera.height, camera.width
    viewmat = torch.as_tensor(camera.viewmat, dtype=torch.float64).to(dtype)
    fx, fy, cx, cy = (float(v) for v in camera.arrays()[1])
    W, t = viewmat[:3, :3], viewmat[:3, 3]
    camera_center = -(W.T @ t)
    if flat:
        scales = scales[:, :2]
    # Remove splats below the thresholds before any division, since NaN gradients would propagate through a mask.
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
    R = W @ rotation_matrices(quats / torch.linalg.vector_norm(quats, dim=-1, keepdim=True))
    axes = R[:, :, : scales.shape[1]] * scales[:, None, :]
    if flat:
        a, b, c, conditional = _footprints(p, axes, camera, 0.0, math.inf)
        broad = c * conditional > MIN_DISC_WIDTH**2 * (a + c)
    else:
        a, b, c, conditional = _footprints(p, axes, camera, camera.blur, TAN_MARGIN)
    extent2 = 2 * torch.log(opacities / ALPHA_MIN) * torch.maximum(a, c)
    directions = means - camera_center
    colors = sh_colors(sh, directions / torch.linalg.vector_norm(directions, dim=-1, keepdim=True))

    columns = torch.arange(width, dtype=dtype) + 0.5
    lines = torch.arange(height, dtype=dtype) + 0.5
    rays = torch.stack([*torch.meshgrid((columns - cx) / fx, (lines - cy) / fy, indexing="xy")], -1)
    rays = torch.cat([rays, torch.ones_like(rays[..., :1])], -1)
    T = torch.ones(height, width, dtype=dtype)
    color = torch.zeros(3, height, width, dtype=dtype)
    depth, median, front, covered, inverse, inverse2 = torch.zeros(6, height, width, dtype=dtype)
    normals = torch.zeros(3, height, width, dtype=dtype)
    probabilities = torch.zeros(height, width, objects, dtype=dtype)
    for n in torch.argsort(z.detach(), stable=True).tolist():
        if not extent2[n] < MAX_EXTENT**2:
            continue
        dy = (lines - v[n])[:, None]
        depths = z[n].expand(height, width)
        if flat:
            power = ((columns[None, :] - u[n]) ** 2 + dy**2) / (2 * EPS_2D_DISC)
            if broad[n]:
                power, depths = _disc_power(rays, p[n], R[n], scales[n], power, camera.near)
        else:
            d = columns[None, :] - u[n] - b[n] / c[n] * dy
            power = 0.5 * (d * d / conditional[n] + dy * dy / c[n])
        raw = opacities[n] * torch.exp(-power)
        drawn = (raw >= ALPHA_MIN) & (T >= TRANSMITTANCE_THRESHOLD)
        alpha = torch.where(drawn, torch.clamp(raw, max=ALPHA_MAX), torch.zeros_like(raw))
        w = alpha * T
        color = color + w * colors[n][:, None, None]
        depth = depth + w * depths
        inverse, inverse2 = inverse + w / depths, inverse2 + w / depths**2
        if flat:
            normal = R[n, :, 2] * -torch.sign(R[n, :, 2] @ p[n])
            normals = normals + w * normal[:, None, None]
        channel = torch.zeros(objects, dtype=dtype)
        channel[int(ids[n])] = 1
        probabilities = probabilities + w[..., None] * channel
        shown = torch.where(T.detach() >= 0.5, w, torch.zeros_like(w)).detach()
        front, covered = front + shown * depths.detach(), covered + shown
        after = T * (1 - alpha)
        median = torch.where((T.detach() >= 0.5) & (after.detach() < 0.5), depths.detach(), median)
        T = after
    # sum_{i<j} w_i w_j (1 / z_i - 1 / z_j)^2
    distortion = (1 - T) * inverse2 - inverse**2
    surface = front / torch.where(covered > 0, covered, torch.ones_like(covered))
    return ReferenceRender(color, 1 - T, depth, median, surface, normals, distortion, probabilities)
