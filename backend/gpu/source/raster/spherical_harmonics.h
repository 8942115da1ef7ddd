// Real spherical harmonics of degree 0 to 3 and their gradient; see spherical_harmonics.py.
#ifndef SPHERICAL_HARMONICS_H
#define SPHERICAL_HARMONICS_H

#include "platform.h"

DEVICE void sh_basis(double x, double y, double z, int count, double *out) {
    out[0] = SH_C0;
    if (count > 1) {
        out[1] = -SH_C1 * y;
        out[2] = SH_C1 * z;
        out[3] = -SH_C1 * x;
    }
    if (count > 4) {
        double xx = x * x, yy = y * y, zz = z * z;
        out[4] = SH_C2 * x * y;
        out[5] = -SH_C2 * y * z;
        out[6] = SH_C20 * (2.0 * zz - xx - yy);
        out[7] = -SH_C2 * x * z;
        out[8] = SH_C2 / 2 * (xx - yy);
        if (count > 9) {
            out[9] = -SH_C33 * y * (3.0 * xx - yy);
            out[10] = SH_C32 * x * y * z;
            out[11] = -SH_C31 * y * (4.0 * zz - xx - yy);
            out[12] = SH_C30 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
            out[13] = -SH_C31 * x * (4.0 * zz - xx - yy);
            out[14] = SH_C32 / 2 * z * (xx - yy);
            out[15] = -SH_C33 * x * (xx - 3.0 * yy);
        }
    }
}

// Writes to `out` the gradient of sum_k g[k] Y_k(x, y, z) with respect to the direction, before its normalization.
DEVICE void sh_gradient(double x, double y, double z, int count, const double *g, double *out) {
    double gx = 0.0, gy = 0.0, gz = 0.0;
    if (count > 1) {
        gy -= SH_C1 * g[1];
        gz += SH_C1 * g[2];
        gx -= SH_C1 * g[3];
    }
    if (count > 4) {
        gx += SH_C2 * y * g[4] - SH_C20 * 2.0 * x * g[6] - SH_C2 * z * g[7] + SH_C2 * x * g[8];
        gy += SH_C2 * x * g[4] - SH_C2 * z * g[5] - SH_C20 * 2.0 * y * g[6] - SH_C2 * y * g[8];
        gz += -SH_C2 * y * g[5] + SH_C20 * 4.0 * z * g[6] - SH_C2 * x * g[7];
    }
    if (count > 9) {
        double xx = x * x, yy = y * y, zz = z * z;
        gx += -SH_C33 * 6.0 * x * y * g[9] + SH_C32 * y * z * g[10] + SH_C31 * 2.0 * x * y * g[11] -
              SH_C30 * 6.0 * x * z * g[12] - SH_C31 * (4.0 * zz - 3.0 * xx - yy) * g[13] + SH_C32 * x * z * g[14] -
              SH_C33 * (3.0 * xx - 3.0 * yy) * g[15];
        gy += -SH_C33 * (3.0 * xx - 3.0 * yy) * g[9] + SH_C32 * x * z * g[10] -
              SH_C31 * (4.0 * zz - xx - 3.0 * yy) * g[11] - SH_C30 * 6.0 * y * z * g[12] +
              SH_C31 * 2.0 * x * y * g[13] - SH_C32 * y * z * g[14] + SH_C33 * 6.0 * x * y * g[15];
        gz += SH_C32 * x * y * g[10] - SH_C31 * 8.0 * y * z * g[11] +
              SH_C30 * (6.0 * zz - 3.0 * xx - 3.0 * yy) * g[12] - SH_C31 * 8.0 * x * z * g[13] +
              SH_C32 / 2 * (xx - yy) * g[14];
    }
    out[0] = gx, out[1] = gy, out[2] = gz;
}

#endif
