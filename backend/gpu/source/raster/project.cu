// Projection of Gaussians to screen splats, one thread per splat; see splats.py for the formulas and the columns.
//
// view (7, 4): three rows of the world-to-camera matrix; fx, fy, cx, cy; limits of x/z and y/z; position and near plane;
// variance of the low-pass filter.
// COEFFICIENTS: of spherical harmonics. HALF_H < 0 marks a splat that is not visible.
#include "projection.h"

struct Outline {
    float du, dv, a, b, c, conditional;
    bool bounded;
};

// An ellipse that encloses the drawn part of a disc, relative to its projected center. reach2: squared number of
// standard deviations, and farthest: value of Q, up to which the disc is drawn.
DEVICE Outline outline_of(const Footprint &f, const Plane &plane, float reach2, float farthest) {
    const float qx = plane.tilt_x, qy = plane.tilt_y, spot2 = reach2 * (float)EPS_2D_DISC;
    if (!f.broad) return {0.0f, 0.0f, spot2, 0.0f, spot2, spot2, true};
    const float area = f.area, a = f.a, b = f.b, c = f.c;
    const float along_x = a * qx + b * qy;
    const float along_y = b * qx + c * qy;
    const float rest = 1.0f - reach2 * (qx * along_x + qy * along_y);
    if (!(rest > 1e-3f)) return {0.0f, 0.0f, 1.0f, 0.0f, 1.0f, 1.0f, false};
    Outline out;
    out.du = reach2 * along_x / rest, out.dv = reach2 * along_y / rest;
    out.a = reach2 * a / rest + out.du * out.du;
    out.b = reach2 * b / rest + out.du * out.dv;
    out.c = reach2 * c / rest + out.dv * out.dv;
    // Its area squared, divided by c.
    out.conditional = reach2 * area / (rest * rest * rest) / out.c * (reach2 * area);
    // The spot has no effect if the disc is wider in every direction.
    const float narrow2 = area * area / (0.5f * (a + c) + sqrtf(0.25f * (a - c) * (a - c) + b * b));
    const float slack = sqrtf(spot2 * (qx * qx + qy * qy));
    if (!(1.0f + slack < farthest && slack < 1.0f && narrow2 * (1.0f - slack) * (1.0f - slack) > (float)EPS_2D_DISC)) {
        float more = sqrtf(spot2) + sqrtf(out.du * out.du + out.dv * out.dv);
        more *= more;
        out.conditional = (out.conditional * out.c + more * (out.a + out.c) + more * more) / (out.c + more);
        out.a += more;
        out.c += more;
    }
    out.bounded = true;
    return out;
}

KERNEL(128, 1) project(
    const float *means, const float *quats, const float *scales, const float *opacities, const float *sh,
    const double *view, int count, int width, int height, float *splats, float *tilts,
    float *outlines) {
    const int n = BLOCK * THREADS_OF_BLOCK + THREAD;
    if (n >= count) return;
    const float near = view[23];
    float *splat = splats + (size_t)n * SPLAT_COLUMNS;
    splat[HALF_H] = -1.0f;
    const float opacity = opacities[n];
    if (!(opacity > (float)ALPHA_MIN)) return;
    const float *mean = means + 3 * (size_t)n, *quat = quats + 4 * (size_t)n;
    double p[3];
    transform(view, mean, p);
    if (!(p[2] > view[23])) return;
    const float norm2 = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3];
    if (!(norm2 > (float)MIN_QUAT_NORM2)) return;
    const float lop = log2f(opacity);
    const float reach = lop - (float)LOG2_CUT, half_log2e = (float)HALF_LOG2E;
    const Footprint f = footprint_of(view, mean, quat, scales + 3 * (size_t)n);
    const double center_u = view[12] * p[0] * f.per_z + view[14], center_v = view[13] * p[1] * f.per_z + view[15];
    const float u = center_u, v = center_v;
    float a = f.a, c = f.c, conditional = f.conditional;
    float middle_u = u, middle_v = v, half_w, half_h, largest;
    // From the center to the image row nearest to it.
    const double to_row = MIN(MAX(center_v, 0.0), height) - center_v;
#if FLAT
    const Plane plane = plane_of(view, f);
    largest = sqrtf(reach * MAX(a, c) / half_log2e);
    Outline out = outline_of(f, plane, reach / half_log2e, (float)p[2] / near);
    if (!out.bounded) {
        out.du = 0.5f * width - u, out.dv = 0.5f * height - v;
        out.a = out.c = out.conditional = 100.0f * ((float)(width + height) * (width + height));
    }
    middle_u = u + out.du, middle_v = v + out.dv;
    half_w = sqrtf(out.a);
    half_h = sqrtf(out.c);
    const float out_slope = out.b / out.c;
    float *outline = outlines + (size_t)n * SPLAT_COLUMNS;
    outline[U] = middle_u + out_slope * (MIN(MAX(middle_v, 0.0f), (float)height) - middle_v);
    outline[V] = middle_v;
    outline[SLOPE] = out_slope;
    outline[A] = reach / out.conditional;
    outline[C] = reach / out.c;
    outline[LOP] = lop;
    outline[HALF_W] = half_w;
    outline[HALF_H] = half_h;
    double tilt_x = plane.tilt_x, tilt_y = plane.tilt_y;
    if (!f.broad) {
        c = conditional = (float)(HALF_LOG2E / SPOT);
        tilt_x = tilt_y = 0.0;
    }
    const double along = tilt_x * f.slope + tilt_y;
    float *tilt = tilts + (size_t)n * TILT_COLUMNS;
    tilt[Q0] = 1.0 + along * to_row;
    tilt[QX] = tilt_x;
    tilt[QY] = along;
    tilt[NEAREST] = f.broad ? near / (float)p[2] : (float)INFINITE;
    tilt[SPOT_U] = u;
    tilt[MIDDLE] = middle_v;
    for (int i = 0; i < 3; i++) tilt[NORMAL_X + i] = plane.normal[i];
#else
    half_w = sqrtf(reach * a / half_log2e);
    half_h = sqrtf(reach * c / half_log2e);
    largest = MAX(half_w, half_h);
#endif
    // The tests are false for NaN and Inf.
    if (!(middle_u + half_w > 0.0f && middle_u - half_w < width && middle_v + half_h > 0.0f &&
          middle_v - half_h < height))
        return;
    if (!(largest < (float)MAX_EXTENT)) return;
    const float dx = mean[0] - view[20], dy = mean[1] - view[21], dz = mean[2] - view[22];
    const float per_length = 1.0f / sqrtf(dx * dx + dy * dy + dz * dz);
    float basis[COEFFICIENTS];
    sh_basis(dx * per_length, dy * per_length, dz * per_length, COEFFICIENTS, basis);
    bool finite = true;
    for (int channel = 0; channel < 3; channel++) {
        float value = 0.5f;
        for (int k = 0; k < COEFFICIENTS; k++) value += basis[k] * sh[((size_t)n * COEFFICIENTS + k) * 3 + channel];
        finite = finite && fabsf(value) < (float)MAX_COLOR;
        splat[RED + channel] = MAX(value, 0.0f);
    }
    if (!finite) return;
    splat[U] = center_u + f.slope * to_row;
    splat[V] = v;
    splat[SLOPE] = f.slope;
    splat[A] = half_log2e / conditional;
    splat[C] = half_log2e / c;
    splat[LOP] = lop;
    splat[DEPTH] = p[2];
    splat[HALF_W] = half_w;
    splat[HALF_H] = half_h;
}
