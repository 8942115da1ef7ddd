"""Projection of discs (2D Gaussians, Huang et al. 2024) by intersection of pixels' rays with the discs' planes.

With the projected center (u, v), its depth z, and the covariance [[a, b], [b, c]] of the footprint from the
projection's Jacobian (as for 3D Gaussians, but without low-pass filter and clamping),

    log2 alpha(x, y) = lop - (A d^2 + C dy^2) / Q^2,   d = x - u - s dy,   dy = y - v,
    Q(x, y) = 1 + qx (x - u) + qy (y - v) = z / (depth at the intersection),

This is exact, since Q times the intersection's coordinates in the disc is an affine function of the pixel. A disc is
therefore a screen splat (splats.py) plus the values that determine Q, in a row of `tilts`. Rays parallel to the plane
have Q = 0; rays that intersect it behind the camera have Q < 0.

As a low-pass filter, the exponent is never smaller than that of a spot around (u, v) in the image, at the depth of the
center.
"""

from __future__ import annotations

import math

import numpy as np

from .kernel import kernel
from .settings import EPS_2D_DISC, MIN_DISC_WIDTH

# Columns of a disc's row in `tilts`: Q at the point of the ridge d = 0 that the splat's column U refers to; slope of Q
# in x, and along the ridge in y; the smallest 1 / Q that is drawn; u; the center of the range of rows that it may cover
# (center - HALF_H to center + HALF_H); the normal in camera space, towards the camera.
Q0, QX, QY, NEAREST, SPOT_U, MIDDLE, NORMAL_X, NORMAL_Y, NORMAL_Z = range(9)
TILT_COLUMNS = 12

SPOT = 0.5 / math.log(2.0) / EPS_2D_DISC
"""Decrease of the spot's log2 alpha per square pixel."""


@kernel()
def disc_footprint(T, R, scales, n, V0, V1):
    """Compute V = T (first two columns of R, times scales[n]), as its two rows V0 and V1.

    Returns a, b, c of V V^T, a - b^2 / c, the determinant of V, and whether the disc is wide enough in the image for
    its plane to be drawn.
    """
    for j in range(2):
        scale = np.float64(scales[n, j])
        V0[j] = (T[0, 0] * R[0, j] + T[0, 1] * R[1, j] + T[0, 2] * R[2, j]) * scale
        V1[j] = (T[1, 0] * R[0, j] + T[1, 1] * R[1, j] + T[1, 2] * R[2, j]) * scale
    a = V0[0] * V0[0] + V0[1] * V0[1]
    b = V0[0] * V1[0] + V0[1] * V1[1]
    c = V1[0] * V1[0] + V1[1] * V1[1]
    area = V0[0] * V1[1] - V0[1] * V1[0]
    broad = area * area > MIN_DISC_WIDTH * MIN_DISC_WIDTH * (a + c)
    return a, b, c, area * area / c if broad else 1.0, area, broad


@kernel()
def disc_plane(px, py, pz, fx, fy, W, R):
    """Compute the plane of a disc.

    Returns the normal towards the camera (3 values); 1 or -1, its sign relative to the third column of R; its dot
    product with the center (< 0), which is the negative distance of the camera from the plane; and qx, qy.
    """
    nx = W[0, 0] * R[0, 2] + W[0, 1] * R[1, 2] + W[0, 2] * R[2, 2]
    ny = W[1, 0] * R[0, 2] + W[1, 1] * R[1, 2] + W[1, 2] * R[2, 2]
    nz = W[2, 0] * R[0, 2] + W[2, 1] * R[1, 2] + W[2, 2] * R[2, 2]
    height = px * nx + py * ny + pz * nz
    side = 1.0
    if height > 0.0:
        nx, ny, nz, side, height = -nx, -ny, -nz, -1.0, -height
    return nx, ny, nz, side, height, pz * nx / (fx * height), pz * ny / (fy * height)


@kernel()
def disc_outline(a, b, c, area, broad, qx, qy, reach2, farthest):
    """Compute an ellipse that encloses the drawn part of a disc.

    reach2: squared number of standard deviations up to which the disc is drawn; farthest: value of Q up to which it is
    drawn. Returns the ellipse's center relative to (u, v), a, b, c, a - b^2 / c, and whether it is bounded; a disc that
    extends behind the camera may cover any part of the image.
    """
    spot2 = reach2 * EPS_2D_DISC
    if not broad:
        return 0.0, 0.0, spot2, 0.0, spot2, spot2, True
    along_x = a * qx + b * qy
    along_y = b * qx + c * qy
    rest = 1.0 - reach2 * (qx * along_x + qy * along_y)
    if not rest > 1e-3:
        return 0.0, 0.0, 1.0, 0.0, 1.0, 1.0, False
    du, dv = reach2 * along_x / rest, reach2 * along_y / rest
    out_a = reach2 * a / rest + du * du
    out_b = reach2 * b / rest + du * dv
    out_c = reach2 * c / rest + dv * dv
    out_area2 = (reach2 * area) ** 2 / (rest * rest * rest)
    # The spot has no effect if the disc is wider in every direction.
    narrow2 = area * area / (0.5 * (a + c) + math.sqrt(0.25 * (a - c) * (a - c) + b * b))
    slack = math.sqrt(spot2 * (qx * qx + qy * qy))
    if not (1.0 + slack < farthest and slack < 1.0 and narrow2 * (1.0 - slack) * (1.0 - slack) > EPS_2D_DISC):
        more = (math.sqrt(spot2) + math.sqrt(du * du + dv * dv)) ** 2
        out_area2 += more * (out_a + out_c) + more * more
        out_a += more
        out_c += more
    return du, dv, out_a, out_b, out_c, out_area2 / out_c, True
