"""Projection of a 3D Gaussian or disc to a screen splat, and its gradient, on the CPU; `backend/gpu` has that of GPUs.

3D Gaussians follow EWA splatting (Zwicker et al. 2001). A screen splat is stored in a form without cancellation within
a pixel row: with the projected covariance [[a, b], [b, c]] (including the low-pass filter) and dy = y - v,

    log2 alpha(x, y) = lop - A (x - u - s dy)^2 - C dy^2,
    s = b / c,  A = k / (a - b^2 / c),  C = k / c,  k = log2(e) / 2,

which equals the usual quadratic form but remains accurate for long diagonal needles. The ridge x = u + s dy is stored
as its column U in the image row nearest to v, so that a needle whose center is far away keeps its position. Inputs and
outputs are float32. Intermediate computations are float64, because this stage takes a small fraction of the time and
determinants would underflow; conversions are explicit, as float() of a float32 is a float32 in a kernel.
"""

from __future__ import annotations

import math

import numpy as np

from .camera import Camera
from .discs import (
    MIDDLE,
    NEAREST,
    NORMAL_X,
    NORMAL_Y,
    NORMAL_Z,
    Q0,
    QX,
    QY,
    SPOT,
    SPOT_U,
    disc_footprint,
    disc_outline,
    disc_plane,
)
from .kernel import kernel
from .settings import ALPHA_MIN, MAX_EXTENT, MIN_QUAT_NORM2, TAN_MARGIN
from .spherical_harmonics import sh_basis, sh_gradient

# Columns of a screen splat.
U, V, SLOPE, A, C, LOP, RED, GREEN, BLUE, DEPTH, HALF_W, HALF_H = range(12)
SPLAT_COLUMNS = 12
# Columns of a gradient row: moments of dL/d(log2 alpha) over the splat's pixels, then color and depth.
M0, MY, MYY, MX, MXY, MXX, G_RED, G_GREEN, G_BLUE, G_DEPTH = range(10)
# For discs, all moments except the first are over the pixels where the plane is drawn, divided by Q^2; they are
# followed by moments of dL/dQ there, moments of dL/d(log2 alpha) in the spot and, if requested, the normal's gradient.
MQ, MQX, MQY, MSX, MSY = range(10, 15)
G_NORMAL = 16
GRADIENT_COLUMNS = 16  # Padded to one cache line, which is written as one vector.

MAX_COLOR = 3e38  # Within the range of float32.

_HALF_LOG2E = 0.5 / math.log(2.0)
_LN2 = math.log(2.0)
_LOG2_CUT = math.log2(ALPHA_MIN)


@kernel()
def _rotation(qw, qx, qy, qz, R):
    R[0, 0] = 1.0 - 2.0 * (qy * qy + qz * qz)
    R[0, 1] = 2.0 * (qx * qy - qw * qz)
    R[0, 2] = 2.0 * (qx * qz + qw * qy)
    R[1, 0] = 2.0 * (qx * qy + qw * qz)
    R[1, 1] = 1.0 - 2.0 * (qx * qx + qz * qz)
    R[1, 2] = 2.0 * (qy * qz - qw * qx)
    R[2, 0] = 2.0 * (qx * qz - qw * qy)
    R[2, 1] = 2.0 * (qy * qz + qw * qx)
    R[2, 2] = 1.0 - 2.0 * (qx * qx + qy * qy)


@kernel()
def _jacobian(px, py, pz, fx, fy, tan_limits, T, W):
    """Compute T = J W, with clamped tangents of the ray, to bound the footprints of distant off-screen splats."""
    tx = min(max(px / pz, tan_limits[0]), tan_limits[1])
    ty = min(max(py / pz, tan_limits[2]), tan_limits[3])
    for i in range(3):
        T[0, i] = fx / pz * (W[0, i] - tx * W[2, i])
        T[1, i] = fy / pz * (W[1, i] - ty * W[2, i])
    return tx, ty


@kernel()
def _footprint(T, R, scales, n, blur, V0, V1):
    """Compute V = T R diag(scales[n]) as its two rows; returns a, b, c of V V^T + blur and a - b^2 / c."""
    a = 0.0
    b = 0.0
    c = 0.0
    for j in range(3):
        scale = np.float64(scales[n, j])
        V0[j] = (T[0, 0] * R[0, j] + T[0, 1] * R[1, j] + T[0, 2] * R[2, j]) * scale
        V1[j] = (T[1, 0] * R[0, j] + T[1, 1] * R[1, j] + T[1, 2] * R[2, j]) * scale
        a += V0[j] * V0[j]
        b += V0[j] * V1[j]
        c += V1[j] * V1[j]
    # The determinant of V V^T is the squared area of the parallelogram spanned by V's rows; a c - b^2 would cancel for
    # diagonal needles.
    x = V0[1] * V1[2] - V0[2] * V1[1]
    y = V0[2] * V1[0] - V0[0] * V1[2]
    z = V0[0] * V1[1] - V0[1] * V1[0]
    conditional = (x * x + y * y + z * z + blur * (a + c + blur)) / (c + blur)
    return a + blur, b, c + blur, conditional


@kernel()
def tangent_limits(fx, fy, cx, cy, left, top, right, bottom):
    """Return the limits of x/z and y/z: the field of view of the whole image with a margin on each side."""
    limits = np.empty(4)
    across, down = TAN_MARGIN * 0.5 * (right - left), TAN_MARGIN * 0.5 * (bottom - top)
    limits[0] = (left - across - cx) / fx
    limits[1] = (right + across - cx) / fx
    limits[2] = (top - down - cy) / fy
    limits[3] = (bottom + down - cy) / fy
    return limits


def view_of(camera: Camera, flat: bool) -> np.ndarray:
    """Return the camera in the format of the projection kernels.

    Args:
        camera: the camera.
        flat: whether the primitives are discs, whose projection is not clamped.

    Returns:
        (7, 4) float64: three rows of the world-to-camera matrix; fx, fy, cx, cy; the limits of x/z and y/z; the
        camera's position and near plane; the variance of the low-pass filter.
    """
    viewmat, intrinsics = camera.arrays()
    fx, fy, cx, cy = (float(v) for v in intrinsics)
    limits = tangent_limits(fx, fy, cx, cy, *camera.bounds)
    if flat:
        limits = np.array([-np.inf, np.inf, -np.inf, np.inf])
    others = [[*camera.center, camera.near], [camera.blur, 0.0, 0.0, 0.0]]
    return np.concatenate([viewmat[:3], [intrinsics, limits, *others]])


@kernel(inline=True)
def project_splat(
    n, means, quats, scales, opacities, sh, view, width, height, splats, tilts, outlines, R, T, V0, V1, basis
):  # fmt: skip
    """Write row n of `splats`; HALF_H < 0 marks a splat that is not visible. Arrays as in `project`.

    Temporary arrays: R (3, 3), T (2, 3), V0 and V1 (3,), basis (16,), float64.
    """
    fx, fy, cx, cy = view[3, 0], view[3, 1], view[3, 2], view[3, 3]
    near = view[5, 3]
    count = sh.shape[1]
    splats[n, HALF_H] = -1.0
    opacity = np.float64(opacities[n])
    if not opacity > ALPHA_MIN:
        return
    mx, my, mz = np.float64(means[n, 0]), np.float64(means[n, 1]), np.float64(means[n, 2])
    px = view[0, 0] * mx + view[0, 1] * my + view[0, 2] * mz + view[0, 3]
    py = view[1, 0] * mx + view[1, 1] * my + view[1, 2] * mz + view[1, 3]
    pz = view[2, 0] * mx + view[2, 1] * my + view[2, 2] * mz + view[2, 3]
    if not pz > near:
        return
    qw, qx, qy, qz = (
        np.float64(quats[n, 0]),
        np.float64(quats[n, 1]),
        np.float64(quats[n, 2]),
        np.float64(quats[n, 3]),
    )
    norm2 = qw * qw + qx * qx + qy * qy + qz * qz
    if not norm2 > MIN_QUAT_NORM2:
        return
    inverse = 1.0 / math.sqrt(norm2)
    _rotation(qw * inverse, qx * inverse, qy * inverse, qz * inverse, R)
    u = fx * px / pz + cx
    v = fy * py / pz + cy
    lop = math.log2(opacity)
    reach = lop - _LOG2_CUT
    middle_u, middle_v = u, v
    if tilts is None:
        _jacobian(px, py, pz, fx, fy, view[4], T, view)
        a, b, c, conditional = _footprint(T, R, scales, n, view[6, 0], V0, V1)
        half_w = math.sqrt(reach * a / _HALF_LOG2E)
        half_h = math.sqrt(reach * c / _HALF_LOG2E)
        largest = max(half_w, half_h)
    else:
        _jacobian(px, py, pz, fx, fy, view[4], T, view)
        a, b, c, conditional, area, broad = disc_footprint(T, R, scales, n, V0, V1)
        nx, ny, nz, _side, _distance, tilt_x, tilt_y = disc_plane(px, py, pz, fx, fy, view, R)
        largest = math.sqrt(reach * max(a, c) / _HALF_LOG2E)
        du, dv, out_a, out_b, out_c, out_conditional, bounded = disc_outline(
            a, b, c, area, broad, tilt_x, tilt_y, reach / _HALF_LOG2E, pz / near
        )
        if not bounded:
            du, dv = 0.5 * width - u, 0.5 * height - v
            out_a = out_c = out_conditional = 100.0 * (width + height) ** 2
        middle_u, middle_v = u + du, v + dv
        half_w = math.sqrt(out_a)
        half_h = math.sqrt(out_c)
        out_slope = out_b / out_c
        outlines[n, U] = middle_u + out_slope * (min(max(middle_v, 0.0), height) - middle_v)
        outlines[n, V] = middle_v
        outlines[n, SLOPE] = out_slope
        outlines[n, A] = reach / out_conditional
        outlines[n, C] = reach / out_c
        outlines[n, LOP] = lop
        outlines[n, HALF_W] = half_w
        outlines[n, HALF_H] = half_h
        if not broad:
            a, b, c, conditional = 1.0, 0.0, _HALF_LOG2E / SPOT, _HALF_LOG2E / SPOT
            tilt_x = tilt_y = 0.0
        # Along the ridge, from (u, v) to the image row nearest to it.
        along = tilt_x * b / c + tilt_y
        tilts[n, Q0] = 1.0 + along * (min(max(v, 0.0), height) - v)
        tilts[n, QX] = tilt_x
        tilts[n, QY] = along
        tilts[n, NEAREST] = near / pz if broad else np.inf
        tilts[n, SPOT_U] = u
        tilts[n, MIDDLE] = middle_v
        tilts[n, NORMAL_X] = nx
        tilts[n, NORMAL_Y] = ny
        tilts[n, NORMAL_Z] = nz
    # The tests are false for NaN and Inf.
    if not (
        middle_u + half_w > 0.0 and middle_u - half_w < width and middle_v + half_h > 0.0 and middle_v - half_h < height
    ):
        return
    if not (largest < MAX_EXTENT):
        return
    dx, dy, dz = mx - view[5, 0], my - view[5, 1], mz - view[5, 2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    sh_basis(dx / length, dy / length, dz / length, count, basis)
    finite = True
    for channel in range(3):
        value = 0.5
        for k in range(count):
            value += basis[k] * sh[n, k, channel]
        finite = finite and abs(value) < MAX_COLOR
        splats[n, RED + channel] = max(value, 0.0)
    if not finite:
        return
    splats[n, U] = u + b / c * (min(max(v, 0.0), height) - v)
    splats[n, V] = v
    splats[n, SLOPE] = b / c
    splats[n, A] = _HALF_LOG2E / conditional
    splats[n, C] = _HALF_LOG2E / c
    splats[n, LOP] = lop
    splats[n, DEPTH] = pz
    splats[n, HALF_W] = half_w
    splats[n, HALF_H] = half_h


@kernel(inline=True)
def no_gradient(n, g_means, g_quats, g_scales, g_opacities, g_sh, g_screen):
    """Set the gradients of splat n to 0."""
    for i in range(3):
        g_means[n, i] = 0.0
        g_scales[n, i] = 0.0
        for k in range(g_sh.shape[1]):
            g_sh[n, k, i] = 0.0
    for i in range(4):
        g_quats[n, i] = 0.0
    g_opacities[n] = 0.0
    g_screen[n, 0] = 0.0
    g_screen[n, 1] = 0.0


@kernel(inline=True)
def project_splat_backward(
    n, g, with_normals, means, quats, scales, opacities, sh, view, splats, tilts,
    g_means, g_quats, g_scales, g_opacities, g_sh, g_screen, R, T, V0, V1, basis, gR, gT, weights, g_color,
):  # fmt: skip
    """Propagate g, the sum of splat n's gradient rows in float64, to the gradients of its parameters.

    Arguments as in `project_backward`; temporary arrays as in `project_splat`, and gR (3, 3), gT (2, 3), weights (16,),
    g_color (3,).
    """
    fx, fy = view[3, 0], view[3, 1]
    axes = 3
    if tilts is not None:
        axes = 2
        g_scales[n, 2] = 0.0
    count = sh.shape[1]
    mx, my, mz = np.float64(means[n, 0]), np.float64(means[n, 1]), np.float64(means[n, 2])
    px = view[0, 0] * mx + view[0, 1] * my + view[0, 2] * mz + view[0, 3]
    py = view[1, 0] * mx + view[1, 1] * my + view[1, 2] * mz + view[1, 3]
    pz = view[2, 0] * mx + view[2, 1] * my + view[2, 2] * mz + view[2, 3]
    qw, qx, qy, qz = (
        np.float64(quats[n, 0]),
        np.float64(quats[n, 1]),
        np.float64(quats[n, 2]),
        np.float64(quats[n, 3]),
    )
    inverse = 1.0 / math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
    qw, qx, qy, qz = qw * inverse, qx * inverse, qy * inverse, qz * inverse
    _rotation(qw, qx, qy, qz, R)
    tx, ty = _jacobian(px, py, pz, fx, fy, view[4], T, view)
    if tilts is None:
        _a, b, c, conditional = _footprint(T, R, scales, n, view[6, 0], V0, V1)
    else:
        _a, b, c, conditional, _area, broad = disc_footprint(T, R, scales, n, V0, V1)
        if not broad:
            b, c = 0.0, 1.0
    slope = b / c
    quad_a = _HALF_LOG2E / conditional
    quad_c = _HALF_LOG2E / c

    g_u = 2.0 * quad_a * g[MX]
    g_v = 2.0 * quad_c * g[MY] - 2.0 * quad_a * slope * g[MX]
    g_slope = 2.0 * quad_a * g[MXY]
    g_conditional = g[MXX] * quad_a / conditional
    g_b = g_slope / c
    g_c = g[MYY] * quad_c / c
    if tilts is not None:
        nx, ny, nz, side, distance, tilt_x, tilt_y = disc_plane(px, py, pz, fx, fy, view, R)
        g_u += 2.0 * SPOT * g[MSX]
        g_v += 2.0 * SPOT * g[MSY]
        g_qx = g_qy = 0.0
        if broad:
            g_u -= tilt_x * g[MQ]
            g_v -= tilt_y * g[MQ]
            g_qx = g[MQX] + slope * g[MQY]
            g_qy = g[MQY]
    g_screen[n, 0] = g_u
    g_screen[n, 1] = g_v
    g_opacities[n] = g[M0] / (_LN2 * np.float64(opacities[n]))

    # From the covariance to V = T R diag(scale), then to its three factors. The gradient of the conditional variance is
    # along V0 - slope V1; split into a, b and c, it would cancel for needles.
    for i in range(2):
        for j in range(3):
            gT[i, j] = 0.0
    for j in range(axes):
        scale = np.float64(scales[n, j])
        across = V0[j] - slope * V1[j]
        gV0 = 2.0 * g_conditional * across + g_b * V1[j]
        gV1 = g_b * (across - slope * V1[j]) + 2.0 * (g_c * V1[j] - slope * g_conditional * across)
        g_scale = 0.0
        for i in range(3):
            gM = T[0, i] * gV0 + T[1, i] * gV1
            g_scale += R[i, j] * gM
            gR[i, j] = gM * scale
            gT[0, i] += gV0 * R[i, j] * scale
            gT[1, i] += gV1 * R[i, j] * scale
        g_scales[n, j] = g_scale
    g_px = g_py = g_pz = 0.0
    if tilts is not None:
        gn_x = gn_y = gn_z = 0.0
        if broad:
            kx, ky = g_qx * pz / (fx * distance), g_qy * pz / (fy * distance)
            back = (kx * nx + ky * ny) / distance
            g_px, g_py, g_pz = -back * nx, -back * ny, back * (distance / pz - nz)
            gn_x, gn_y, gn_z = kx - back * px, ky - back * py, -back * pz
        if with_normals:
            gn_x, gn_y, gn_z = gn_x + g[G_NORMAL], gn_y + g[G_NORMAL + 1], gn_z + g[G_NORMAL + 2]
        for i in range(3):
            gR[i, 2] = side * (view[0, i] * gn_x + view[1, i] * gn_y + view[2, i] * gn_z)

    # Gradient of the quaternion, tangent to the unit sphere.
    gw = 2.0 * (qz * (gR[1, 0] - gR[0, 1]) + qy * (gR[0, 2] - gR[2, 0]) + qx * (gR[2, 1] - gR[1, 2]))
    gx = 2.0 * (
        qy * (gR[0, 1] + gR[1, 0]) + qz * (gR[0, 2] + gR[2, 0]) + qw * (gR[2, 1] - gR[1, 2])
        - 2.0 * qx * (gR[1, 1] + gR[2, 2])
    )  # fmt: skip
    gy = 2.0 * (
        qx * (gR[0, 1] + gR[1, 0]) + qz * (gR[1, 2] + gR[2, 1]) + qw * (gR[0, 2] - gR[2, 0])
        - 2.0 * qy * (gR[0, 0] + gR[2, 2])
    )  # fmt: skip
    gz = 2.0 * (
        qx * (gR[0, 2] + gR[2, 0]) + qy * (gR[1, 2] + gR[2, 1]) + qw * (gR[1, 0] - gR[0, 1])
        - 2.0 * qz * (gR[0, 0] + gR[1, 1])
    )  # fmt: skip
    along = gw * qw + gx * qx + gy * qy + gz * qz
    g_quats[n, 0] = (gw - along * qw) * inverse
    g_quats[n, 1] = (gx - along * qx) * inverse
    g_quats[n, 2] = (gy - along * qy) * inverse
    g_quats[n, 3] = (gz - along * qz) * inverse

    # Camera-space position: through the center, the depth and the Jacobian.
    to_x = g_u * fx / pz
    to_y = g_v * fy / pz
    g_px += to_x
    g_py += to_y
    g_pz += g[G_DEPTH] - (to_x * px + to_y * py) / pz
    g_tx = 0.0
    g_ty = 0.0
    for i in range(3):
        g_tx -= gT[0, i] * fx / pz * view[2, i]
        g_ty -= gT[1, i] * fy / pz * view[2, i]
        g_pz -= (gT[0, i] * T[0, i] + gT[1, i] * T[1, i]) / pz
    if view[4, 0] <= px / pz <= view[4, 1]:
        g_px += g_tx / pz
        g_pz -= g_tx * tx / pz
    if view[4, 2] <= py / pz <= view[4, 3]:
        g_py += g_ty / pz
        g_pz -= g_ty * ty / pz

    # Color: through the SH coefficients and the viewing direction.
    dx, dy, dz = mx - view[5, 0], my - view[5, 1], mz - view[5, 2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx / length, dy / length, dz / length
    sh_basis(dx, dy, dz, count, basis)
    for channel in range(3):
        g_color[channel] = g[G_RED + channel] if splats[n, RED + channel] > 0.0 else 0.0
    for k in range(count):
        weights[k] = 0.0
        for channel in range(3):
            g_sh[n, k, channel] = basis[k] * g_color[channel]
            weights[k] += g_color[channel] * sh[n, k, channel]
    sx, sy, sz = sh_gradient(dx, dy, dz, count, weights)
    radial = sx * dx + sy * dy + sz * dz
    g_means[n, 0] = view[0, 0] * g_px + view[1, 0] * g_py + view[2, 0] * g_pz + (sx - radial * dx) / length
    g_means[n, 1] = view[0, 1] * g_px + view[1, 1] * g_py + view[2, 1] * g_pz + (sy - radial * dy) / length
    g_means[n, 2] = view[0, 2] * g_px + view[1, 2] * g_py + view[2, 2] * g_pz + (sz - radial * dz) / length


def gradient_columns(flat: bool, with_normals: bool) -> int:
    """Return the number of columns of a gradient row that are in use."""
    if not flat:
        return G_DEPTH + 1
    return G_NORMAL + 3 if with_normals else MSY + 1
