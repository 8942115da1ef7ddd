// Gradient of the projection: the gradient rows of each splat are summed, and propagated to its parameters.
//
// rows: gradient rows of ROW columns, of which COLUMNS are in use; those of splat n are first_rows[n] to
// last_rows[n] - 1. A block of SPLATS_PER_BLOCK threads processes as many splats.
#include "projection.h"

#define ABREAST (SPLATS_PER_BLOCK / COLUMNS_ABREAST)

KERNEL(SPLATS_PER_BLOCK, 1) project_backward(
    const float *means, const float *quats, const float *scales, const float *opacities, const float *sh,
    const double *view, const float *splats, const long long *first_rows, const long long *last_rows,
    const float *rows, int count, float *g_means, float *g_quats, float *g_scales,
    float *g_opacities, float *g_sh, float *g_screen) {
    SHARED(double, sums, [SPLATS_PER_BLOCK][COLUMNS]);
    const int thread = THREAD, begin = BLOCK * SPLATS_PER_BLOCK;
    // Neighboring threads read neighboring columns of a row; each sum is in a fixed order.
    for (int member = thread / COLUMNS_ABREAST; member < SPLATS_PER_BLOCK; member += ABREAST) {
        if (begin + member >= count) break;
        const long long first = first_rows[begin + member], last = last_rows[begin + member];
        for (int column = thread % COLUMNS_ABREAST; column < COLUMNS; column += COLUMNS_ABREAST) {
            double total = 0.0;
            for (long long row = first; row < last; row++) total += rows[row * ROW + column];
            sums[member][column] = total;
        }
    }
    sync_block();
    const int n = begin + thread;
    if (n >= count) return;
    const size_t at = n;
    if (first_rows[n] == last_rows[n]) {
        for (int i = 0; i < 3; i++) g_means[3 * at + i] = g_scales[3 * at + i] = 0.0f;
        for (int i = 0; i < 3 * COEFFICIENTS; i++) g_sh[at * 3 * COEFFICIENTS + i] = 0.0f;
        for (int i = 0; i < 4; i++) g_quats[4 * at + i] = 0.0f;
        g_opacities[n] = g_screen[2 * at] = g_screen[2 * at + 1] = 0.0f;
        return;
    }
    float g[COLUMNS];
    for (int column = 0; column < COLUMNS; column++) g[column] = sums[thread][column];

    const float *mean = means + 3 * at, *quat = quats + 4 * at;
    const float inverse =
        1.0f / sqrtf(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]);
    float q[4];
    for (int i = 0; i < 4; i++) q[i] = quat[i] * inverse;
    const Footprint f = footprint_of(view, mean, quat, scales + 3 * at);
    const double *p = f.p;
    const float slope = f.slope, conditional = f.conditional, c = FLAT && !f.broad ? 1.0f : (float)f.c;
    const float quad_a = (float)HALF_LOG2E / conditional;
    const float quad_c = (float)HALF_LOG2E / c;

    // In double, as far as g_p, since the terms of a needle whose center is far outside the image cancel.
    double g_u = 2.0 * HALF_LOG2E / f.conditional * sums[thread][MX];
    double g_v = 2.0f * quad_c * g[MY] - f.slope * g_u;
    const float g_conditional = g[MXX] * quad_a / conditional;
    const float g_b = 2.0f * quad_a * g[MXY] / c;
    const float g_c = g[MYY] * quad_c / c;
#if FLAT
    const Plane plane = plane_of(view, f);
    float g_qx = 0.0f, g_qy = 0.0f;
    g_u += 2.0f * (float)SPOT * g[MSX];
    g_v += 2.0f * (float)SPOT * g[MSY];
    if (f.broad) {
        g_u -= plane.tilt_x * g[MQ];
        g_v -= plane.tilt_y * g[MQ];
        g_qx = g[MQX] + slope * g[MQY];
        g_qy = g[MQY];
    }
    g_scales[3 * at + 2] = 0.0f;
#endif
    g_screen[2 * at] = g_u;
    g_screen[2 * at + 1] = g_v;
    g_opacities[n] = g[M0] / ((float)LN2 * opacities[n]);

    // From the covariance to V = T R diag(scale), then to its three factors. The gradient of the conditional variance is
    // along V[0] - slope V[1]; split into a, b and c, it would cancel for needles.
    double gT[2][3] = {{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}};
    float gR[3][3];
    for (int j = 0; j < AXES; j++) {
        const float scale = scales[3 * at + j];
        const double down = f.V[1][j], across = f.V[0][j] - f.slope * down;
        const double g_0 = 2.0f * g_conditional * across + g_b * down;
        const double g_1 = g_b * across + 2.0f * g_c * down - f.slope * g_0;
        const double by_0 = g_0 * scale, by_1 = g_1 * scale;
        double g_scale = 0.0;
        for (int i = 0; i < 3; i++) {
            const double gM = f.T[0][i] * g_0 + f.T[1][i] * g_1;
            g_scale += f.R[i][j] * gM;
            gR[i][j] = gM * scale;
            gT[0][i] += by_0 * f.R[i][j];
            gT[1][i] += by_1 * f.R[i][j];
        }
        g_scales[3 * at + j] = g_scale;
    }
    double g_p[3] = {0.0, 0.0, 0.0};
#if FLAT
    // In double, since these terms cancel for discs that are seen edge-on.
    double g_normal[3] = {0.0, 0.0, 0.0};
    if (f.broad) {
        const double per_distance = 1.0 / plane.distance;
        const double kx = g_qx * p[2] * per_distance / view[12], ky = g_qy * p[2] * per_distance / view[13];
        const double back = (kx * plane.normal[0] + ky * plane.normal[1]) * per_distance;
        g_p[0] = -back * plane.normal[0];
        g_p[1] = -back * plane.normal[1];
        g_p[2] = back * (plane.distance / p[2] - plane.normal[2]);
        g_normal[0] = kx - back * p[0];
        g_normal[1] = ky - back * p[1];
        g_normal[2] = -back * p[2];
    }
#if NORMALS
    for (int i = 0; i < 3; i++) g_normal[i] += g[G_NORMAL + i];
#endif
    for (int i = 0; i < 3; i++)
        gR[i][2] = plane.side * (view[i] * g_normal[0] + view[4 + i] * g_normal[1] + view[8 + i] * g_normal[2]);
#endif

    // Gradient of the quaternion, tangent to the unit sphere.
    const float w = q[0], x = q[1], y = q[2], z = q[3];
    float g_q[4];
    g_q[0] = 2.0f * (z * (gR[1][0] - gR[0][1]) + y * (gR[0][2] - gR[2][0]) + x * (gR[2][1] - gR[1][2]));
    g_q[1] = 2.0f * (y * (gR[0][1] + gR[1][0]) + z * (gR[0][2] + gR[2][0]) + w * (gR[2][1] - gR[1][2]) -
                     2.0f * x * (gR[1][1] + gR[2][2]));
    g_q[2] = 2.0f * (x * (gR[0][1] + gR[1][0]) + z * (gR[1][2] + gR[2][1]) + w * (gR[0][2] - gR[2][0]) -
                     2.0f * y * (gR[0][0] + gR[2][2]));
    g_q[3] = 2.0f * (x * (gR[0][2] + gR[2][0]) + y * (gR[1][2] + gR[2][1]) + w * (gR[1][0] - gR[0][1]) -
                     2.0f * z * (gR[0][0] + gR[1][1]));
    const float along = g_q[0] * w + g_q[1] * x + g_q[2] * y + g_q[3] * z;
    for (int i = 0; i < 4; i++) g_quats[4 * at + i] = (g_q[i] - along * q[i]) * inverse;

    // Camera-space position: through the center, the depth and the Jacobian.
    const double to_x = g_u * view[12] * f.per_z;
    const double to_y = g_v * view[13] * f.per_z;
    g_p[0] += to_x;
    g_p[1] += to_y;
    g_p[2] += g[G_DEPTH] - (to_x * p[0] + to_y * p[1]) * f.per_z;
    double g_tx = 0.0, g_ty = 0.0, through_jacobian = 0.0;
    for (int i = 0; i < 3; i++) {
        g_tx -= gT[0][i] * view[8 + i];
        g_ty -= gT[1][i] * view[8 + i];
        through_jacobian += gT[0][i] * f.T[0][i] + gT[1][i] * f.T[1][i];
    }
    g_tx *= view[12] * f.per_z, g_ty *= view[13] * f.per_z;
    g_p[2] -= through_jacobian * f.per_z;
    if (f.tx == p[0] * f.per_z) {
        g_p[0] += g_tx * f.per_z;
        g_p[2] -= g_tx * f.tx * f.per_z;
    }
    if (f.ty == p[1] * f.per_z) {
        g_p[1] += g_ty * f.per_z;
        g_p[2] -= g_ty * f.ty * f.per_z;
    }

    // Color: through the SH coefficients and the viewing direction.
    float d[3], g_d[3];
    for (int i = 0; i < 3; i++) d[i] = mean[i] - view[20 + i];
    const float per_length = 1.0f / sqrtf(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
    for (int i = 0; i < 3; i++) d[i] *= per_length;
    float basis[COEFFICIENTS], weights[COEFFICIENTS], g_color[3];
    sh_basis(d[0], d[1], d[2], COEFFICIENTS, basis);
    for (int channel = 0; channel < 3; channel++)
        g_color[channel] = splats[at * SPLAT_COLUMNS + RED + channel] > 0.0f ? g[G_RED + channel] : 0.0f;
    for (int k = 0; k < COEFFICIENTS; k++) {
        weights[k] = 0.0f;
        for (int channel = 0; channel < 3; channel++) {
            g_sh[(at * COEFFICIENTS + k) * 3 + channel] = basis[k] * g_color[channel];
            weights[k] += g_color[channel] * sh[(at * COEFFICIENTS + k) * 3 + channel];
        }
    }
    sh_gradient(d[0], d[1], d[2], COEFFICIENTS, weights, g_d);
    const float radial = g_d[0] * d[0] + g_d[1] * d[1] + g_d[2] * d[2];
    for (int i = 0; i < 3; i++)
        g_means[3 * at + i] = view[i] * g_p[0] + view[4 + i] * g_p[1] + view[8 + i] * g_p[2] +
                              (g_d[i] - radial * d[i]) * per_length;
}
