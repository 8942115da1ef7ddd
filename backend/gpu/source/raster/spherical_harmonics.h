// Real spherical harmonics of degree 0 to 3 and their gradient; see spherical_harmonics.py.
#ifndef SPHERICAL_HARMONICS_H
#define SPHERICAL_HARMONICS_H

#include "platform.h"

DEVICE void sh_basis(float x, float y, float z, int count, float *out) {
    out[0] = (float)SH_C0;
    if (count > 1) {
        out[1] = -(float)SH_C1 * y;
        out[2] = (float)SH_C1 * z;
        out[3] = -(float)SH_C1 * x;
    }
    if (count > 4) {
        float xx = x * x, yy = y * y, zz = z * z;
        out[4] = (float)SH_C2 * x * y;
        out[5] = -(float)SH_C2 * y * z;
        out[6] = (float)SH_C20 * (2.0f * zz - xx - yy);
        out[7] = -(float)SH_C2 * x * z;
        out[8] = 0.5f * (float)SH_C2 * (xx - yy);
        if (count > 9) {
            out[9] = -(float)SH_C33 * y * (3.0f * xx - yy);
            out[10] = (float)SH_C32 * x * y * z;
            out[11] = -(float)SH_C31 * y * (4.0f * zz - xx - yy);
            out[12] = (float)SH_C30 * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
            out[13] = -(float)SH_C31 * x * (4.0f * zz - xx - yy);
            out[14] = 0.5f * (float)SH_C32 * z * (xx - yy);
            out[15] = -(float)SH_C33 * x * (xx - 3.0f * yy);
        }
    }
}

// Writes to `out` the gradient of sum_k g[k] Y_k(x, y, z) with respect to the direction, before its normalization.
DEVICE void sh_gradient(float x, float y, float z, int count, const float *g, float *out) {
    float gx = 0.0f, gy = 0.0f, gz = 0.0f;
    if (count > 1) {
        gy -= (float)SH_C1 * g[1];
        gz += (float)SH_C1 * g[2];
        gx -= (float)SH_C1 * g[3];
    }
    if (count > 4) {
        gx += (float)SH_C2 * y * g[4] - (float)SH_C20 * 2.0f * x * g[6] - (float)SH_C2 * z * g[7] + (float)SH_C2 * x * g[8];
        gy += (float)SH_C2 * x * g[4] - (float)SH_C2 * z * g[5] - (float)SH_C20 * 2.0f * y * g[6] - (float)SH_C2 * y * g[8];
        gz += -(float)SH_C2 * y * g[5] + (float)SH_C20 * 4.0f * z * g[6] - (float)SH_C2 * x * g[7];
    }
    if (count > 9) {
        float xx = x * x, yy = y * y, zz = z * z;
        gx += -(float)SH_C33 * 6.0f * x * y * g[9] + (float)SH_C32 * y * z * g[10] + (float)SH_C31 * 2.0f * x * y * g[11] -
              (float)SH_C30 * 6.0f * x * z * g[12] - (float)SH_C31 * (4.0f * zz - 3.0f * xx - yy) * g[13] + (float)SH_C32 * x * z * g[14] -
              (float)SH_C33 * (3.0f * xx - 3.0f * yy) * g[15];
        gy += -(float)SH_C33 * (3.0f * xx - 3.0f * yy) * g[9] + (float)SH_C32 * x * z * g[10] -
              (float)SH_C31 * (4.0f * zz - xx - 3.0f * yy) * g[11] - (float)SH_C30 * 6.0f * y * z * g[12] +
              (float)SH_C31 * 2.0f * x * y * g[13] - (float)SH_C32 * y * z * g[14] + (float)SH_C33 * 6.0f * x * y * g[15];
        gz += (float)SH_C32 * x * y * g[10] - (float)SH_C31 * 8.0f * y * z * g[11] +
              (float)SH_C30 * (6.0f * zz - 3.0f * xx - 3.0f * yy) * g[12] - (float)SH_C31 * 8.0f * x * z * g[13] +
              0.5f * (float)SH_C32 * (xx - yy) * g[14];
    }
    out[0] = gx, out[1] = gy, out[2] = gz;
}

#endif
