"""Real spherical harmonics of degree 0 to 3 and their gradient, as kernels."""

from __future__ import annotations

from ..shared.splats.spherical_harmonics import C0, C1, C2, C20, C30, C31, C32, C33
from .kernel import kernel

_C2 = (C2, -C2, C20, -C2, C2 / 2)
_C3 = (-C33, C32, -C31, C30, -C31, C32 / 2, -C33)


@kernel()
def sh_basis(x, y, z, count, out):
    """Write the `count` (1, 4, 9 or 16) real spherical harmonics at the unit direction (x, y, z) to `out`."""
    out[0] = C0
    if count > 1:
        out[1] = -C1 * y
        out[2] = C1 * z
        out[3] = -C1 * x
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        out[4] = _C2[0] * x * y
        out[5] = _C2[1] * y * z
        out[6] = _C2[2] * (2.0 * zz - xx - yy)
        out[7] = _C2[3] * x * z
        out[8] = _C2[4] * (xx - yy)
        if count > 9:
            out[9] = _C3[0] * y * (3.0 * xx - yy)
            out[10] = _C3[1] * x * y * z
            out[11] = _C3[2] * y * (4.0 * zz - xx - yy)
            out[12] = _C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
            out[13] = _C3[4] * x * (4.0 * zz - xx - yy)
            out[14] = _C3[5] * z * (xx - yy)
            out[15] = _C3[6] * x * (xx - 3.0 * yy)


@kernel()
def sh_gradient(x, y, z, count, g):
    """Return the gradient of sum_k g[k] Y_k(x, y, z) with respect to the direction, before its normalization."""
    gx = gy = gz = 0.0
    if count > 1:
        gy -= C1 * g[1]
        gz += C1 * g[2]
        gx -= C1 * g[3]
    if count > 4:
        gx += _C2[0] * y * g[4] + _C2[2] * -2.0 * x * g[6] + _C2[3] * z * g[7] + _C2[4] * 2.0 * x * g[8]
        gy += _C2[0] * x * g[4] + _C2[1] * z * g[5] + _C2[2] * -2.0 * y * g[6] - _C2[4] * 2.0 * y * g[8]
        gz += _C2[1] * y * g[5] + _C2[2] * 4.0 * z * g[6] + _C2[3] * x * g[7]
    if count > 9:
        xx, yy, zz = x * x, y * y, z * z
        gx += (
            _C3[0] * 6.0 * x * y * g[9]
            + _C3[1] * y * z * g[10]
            + _C3[2] * -2.0 * x * y * g[11]
            + _C3[3] * -6.0 * x * z * g[12]
            + _C3[4] * (4.0 * zz - 3.0 * xx - yy) * g[13]
            + _C3[5] * 2.0 * x * z * g[14]
            + _C3[6] * (3.0 * xx - 3.0 * yy) * g[15]
        )
        gy += (
            _C3[0] * (3.0 * xx - 3.0 * yy) * g[9]
            + _C3[1] * x * z * g[10]
            + _C3[2] * (4.0 * zz - xx - 3.0 * yy) * g[11]
            + _C3[3] * -6.0 * y * z * g[12]
            + _C3[4] * -2.0 * x * y * g[13]
            + _C3[5] * -2.0 * y * z * g[14]
            + _C3[6] * -6.0 * x * y * g[15]
        )
        gz += (
            _C3[1] * x * y * g[10]
            + _C3[2] * 8.0 * y * z * g[11]
            + _C3[3] * (6.0 * zz - 3.0 * xx - 3.0 * yy) * g[12]
            + _C3[4] * 8.0 * x * z * g[13]
            + _C3[5] * (xx - yy) * g[14]
        )
    return gx, gy, gz
