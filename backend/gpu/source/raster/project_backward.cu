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
    double g[COLUMNS];
    for (int column = 0; column < COLUMNS; column++) g[column] = sums[thread][column];

    const double fx = view[12], fy = view[13], *limits = view + 16;
    const double mx = means[3 * at], my = means[3 * at + 1], mz = means[3 * at + 2];
    double p[3], q[4];
    transform(view, mx, my, mz, p);
    for (int i = 0; i < 4; i++) q[i] = quats[4 * at + i];
    const double inverse = 1.0 / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int i = 0; i < 4; i++) q[i] *= inverse;
    const Footprint f = footprint_of(view, p, q, scales + 3 * at);
    double b = f.b, c = f.c;
    if (FLAT && !f.broad) b = 0.0, c = 1.0;
    const double slope = b / c;
    const double quad_a = HALF_LOG2E / f.conditional;
    const double quad_c = HALF_LOG2E / c;

    double g_u = 2.0 * quad_a * g[MX];
    double g_v = 2.0 * quad_c * g[MY] - 2.0 * quad_a * slope * g[MX];
    const double g_slope = 2.0 * quad_a * g[MXY];
    const double g_conditional = g[MXX] * quad_a / f.conditional;
    const double g_b = g_slope / c;
    const double g_c = g[MYY] * quad_c / c;
    double g_qx = 0.0, g_qy = 0.0;
    Plane plane;
#if FLAT
    plane = plane_of(view, p, f.R);
    g_u += 2.0 * SPOT * g[MSX];
    g_v += 2.0 * SPOT * g[MSY];
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
    g_opacities[n] = g[M0] / (LN2 * (double)opacities[n]);

    // From the covariance to V = T R diag(scale), then to its three factors. The gradient of the conditional variance is
    // along V[0] - slope V[1]; split into a, b and c, it would cancel for needles.
    double gT[2][3] = {{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}}, gR[3][3];
    for (int j = 0; j < (FLAT ? 2 : 3); j++) {
        const double scale = scales[3 * at + j];
        const double across = f.V[0][j] - slope * f.V[1][j];
        const double g_0 = 2.0 * g_conditional * across + g_b * f.V[1][j];
        const double g_1 =
            g_b * (across - slope * f.V[1][j]) + 2.0 * (g_c * f.V[1][j] - slope * g_conditional * across);
        double g_scale = 0.0;
        for (int i = 0; i < 3; i++) {
            const double gM = f.T[0][i] * g_0 + f.T[1][i] * g_1;
            g_scale += f.R[i][j] * gM;
            gR[i][j] = gM * scale;
            gT[0][i] += g_0 * f.R[i][j] * scale;
            gT[1][i] += g_1 * f.R[i][j] * scale;
        }
        g_scales[3 * at + j] = g_scale;
    }
    double g_p[3] = {0.0, 0.0, 0.0};
#if FLAT
    double g_normal[3] = {0.0, 0.0, 0.0};
    if (f.broad) {
        const double distance = plane.distance;
        const double kx = g_qx * p[2] / (fx * distance), ky = g_qy * p[2] / (fy * distance);
        const double back = (kx * plane.normal[0] + ky * plane.normal[1]) / distance;
        g_p[0] = -back * plane.normal[0];
        g_p[1] = -back * plane.normal[1];
        g_p[2] = back * (distance / p[2] - plane.normal[2]);
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
    const double w = q[0], x = q[1], y = q[2], z = q[3];
    double g_q[4];
    g_q[0] = 2.0 * (z * (gR[1][0] - gR[0][1]) + y * (gR[0][2] - gR[2][0]) + x * (gR[2][1] - gR[1][2]));
    g_q[1] = 2.0 * (y * (gR[0][1] + gR[1][0]) + z * (gR[0][2] + gR[2][0]) + w * (gR[2][1] - gR[1][2]) -
                    2.0 * x * (gR[1][1] + gR[2][2]));
    g_q[2] = 2.0 * (x * (gR[0][1] + gR[1][0]) + z * (gR[1][2] + gR[2][1]) + w * (gR[0][2] - gR[2][0]) -
                    2.0 * y * (gR[0][0] + gR[2][2]));
    g_q[3] = 2.0 * (x * (gR[0][2] + gR[2][0]) + y * (gR[1][2] + gR[2][1]) + w * (gR[1][0] - gR[0][1]) -
                    2.0 * z * (gR[0][0] + gR[1][1]));
    const double along = g_q[0] * w + g_q[1] * x + g_q[2] * y + g_q[3] * z;
    for (int i = 0; i < 4; i++) g_quats[4 * at + i] = (g_q[i] - along * q[i]) * inverse;

    // Camera-space position: through the center, the depth and the Jacobian.
    const double to_x = g_u * fx / p[2];
    const double to_y = g_v * fy / p[2];
    g_p[0] += to_x;
    g_p[1] += to_y;
    g_p[2] += g[G_DEPTH] - (to_x * p[0] + to_y * p[1]) / p[2];
    double g_tx = 0.0, g_ty = 0.0;
    for (int i = 0; i < 3; i++) {
        g_tx -= gT[0][i] * fx / p[2] * view[8 + i];
        g_ty -= gT[1][i] * fy / p[2] * view[8 + i];
        g_p[2] -= (gT[0][i] * f.T[0][i] + gT[1][i] * f.T[1][i]) / p[2];
    }
    if (limits[0] <= p[0] / p[2] && p[0] / p[2] <= limits[1]) {
        g_p[0] += g_tx / p[2];
        g_p[2] -= g_tx * f.tx / p[2];
    }
    if (limits[2] <= p[1] / p[2] && p[1] / p[2] <= limits[3]) {
        g_p[1] += g_ty / p[2];
        g_p[2] -= g_ty * f.ty / p[2];
    }

    // Color: through the SH COEFFICIENTS and the viewing direction.
    double d[3] = {mx - view[20], my - view[21], mz - view[22]}, g_d[3];
    const double length = sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
    for (int i = 0; i < 3; i++) d[i] /= length;
    double basis[COEFFICIENTS], weights[COEFFICIENTS], g_color[3];
    sh_basis(d[0], d[1], d[2], COEFFICIENTS, basis);
    for (int channel = 0; channel < 3; channel++)
        g_color[channel] = splats[at * SPLAT_COLUMNS + RED + channel] > 0.0f ? g[G_RED + channel] : 0.0;
    for (int k = 0; k < COEFFICIENTS; k++) {
        weights[k] = 0.0;
        for (int channel = 0; channel < 3; channel++) {
            g_sh[(at * COEFFICIENTS + k) * 3 + channel] = basis[k] * g_color[channel];
            weights[k] += g_color[channel] * sh[(at * COEFFICIENTS + k) * 3 + channel];
        }
    }
    sh_gradient(d[0], d[1], d[2], COEFFICIENTS, weights, g_d);
    const double radial = g_d[0] * d[0] + g_d[1] * d[1] + g_d[2] * d[2];
    for (int i = 0; i < 3; i++)
        g_means[3 * at + i] = view[i] * g_p[0] + view[4 + i] * g_p[1] + view[8 + i] * g_p[2] +
                              (g_d[i] - radial * d[i]) / length;
}
