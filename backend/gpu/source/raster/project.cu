// Projection of Gaussians to screen splats, one thread per splat; see splats.py for the formulas and the columns.
//
// view (6, 4): three rows of the world-to-camera matrix; fx, fy, cx, cy; limits of x/z and y/z; position and near plane.
// COEFFICIENTS: of spherical harmonics. HALF_H < 0 marks a splat that is not visible.
#include "projection.h"

struct Outline {
    double du, dv, a, b, c, conditional;
    bool bounded;
};

// An ellipse that encloses the drawn part of a disc, relative to its projected center. reach2: squared number of
// standard deviations, and farthest: value of Q, up to which the disc is drawn.
DEVICE Outline outline_of(const Footprint &f, const Plane &plane, double reach2, double farthest) {
    const double qx = plane.tilt_x, qy = plane.tilt_y, spot2 = reach2 * EPS_2D_DISC;
    if (!f.broad) return {0.0, 0.0, spot2, 0.0, spot2, spot2, true};
    double along_x = f.a * qx + f.b * qy;
    double along_y = f.b * qx + f.c * qy;
    double rest = 1.0 - reach2 * (qx * along_x + qy * along_y);
    if (!(rest > 1e-3)) return {0.0, 0.0, 1.0, 0.0, 1.0, 1.0, false};
    Outline out;
    out.du = reach2 * along_x / rest, out.dv = reach2 * along_y / rest;
    out.a = reach2 * f.a / rest + out.du * out.du;
    out.b = reach2 * f.b / rest + out.du * out.dv;
    out.c = reach2 * f.c / rest + out.dv * out.dv;
    double out_area2 = (reach2 * f.area) * (reach2 * f.area) / (rest * rest * rest);
    // The spot has no effect if the disc is wider in every direction.
    double narrow2 = f.area * f.area / (0.5 * (f.a + f.c) + sqrt(0.25 * (f.a - f.c) * (f.a - f.c) + f.b * f.b));
    double slack = sqrt(spot2 * (qx * qx + qy * qy));
    if (!(1.0 + slack < farthest && slack < 1.0 && narrow2 * (1.0 - slack) * (1.0 - slack) > EPS_2D_DISC)) {
        double more = sqrt(spot2) + sqrt(out.du * out.du + out.dv * out.dv);
        more *= more;
        out_area2 += more * (out.a + out.c) + more * more;
        out.a += more;
        out.c += more;
    }
    out.conditional = out_area2 / out.c;
    out.bounded = true;
    return out;
}

KERNEL(128, 1) project(
    const float *means, const float *quats, const float *scales, const float *opacities, const float *sh,
    const double *view, int count, int width, int height, float *splats, float *tilts,
    float *outlines) {
    const int n = BLOCK * THREADS_OF_BLOCK + THREAD;
    if (n >= count) return;
    const double near = view[23];
    float *splat = splats + (size_t)n * SPLAT_COLUMNS;
    splat[HALF_H] = -1.0f;
    const double opacity = opacities[n];
    if (!(opacity > ALPHA_MIN)) return;
    const double mx = means[3 * (size_t)n], my = means[3 * (size_t)n + 1], mz = means[3 * (size_t)n + 2];
    double p[3], q[4];
    transform(view, mx, my, mz, p);
    if (!(p[2] > near)) return;
    for (int i = 0; i < 4; i++) q[i] = quats[4 * (size_t)n + i];
    const double norm2 = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
    if (!(norm2 > MIN_QUAT_NORM2)) return;
    const double inverse = 1.0 / sqrt(norm2);
    for (int i = 0; i < 4; i++) q[i] *= inverse;
    const double u = view[12] * p[0] / p[2] + view[14];
    const double v = view[13] * p[1] / p[2] + view[15];
    const double lop = log2(opacity);
    const double reach = lop - LOG2_CUT;
    const Footprint f = footprint_of(view, p, q, scales + 3 * (size_t)n);
    double a = f.a, b = f.b, c = f.c, conditional = f.conditional;
    double middle_u = u, middle_v = v, half_w, half_h, largest;
    if (FLAT) {
        Plane plane = plane_of(view, p, f.R);
        largest = sqrt(reach * MAX(a, c) / HALF_LOG2E);
        Outline out = outline_of(f, plane, reach / HALF_LOG2E, p[2] / near);
        if (!out.bounded) {
            out.du = 0.5 * width - u, out.dv = 0.5 * height - v;
            out.a = out.c = out.conditional = 100.0 * ((double)(width + height) * (width + height));
        }
        middle_u = u + out.du, middle_v = v + out.dv;
        half_w = sqrt(out.a);
        half_h = sqrt(out.c);
        const double out_slope = out.b / out.c;
        float *outline = outlines + (size_t)n * SPLAT_COLUMNS;
        outline[U] = middle_u + out_slope * (MIN(MAX(middle_v, 0.0), height) - middle_v);
        outline[V] = middle_v;
        outline[SLOPE] = out_slope;
        outline[A] = reach / out.conditional;
        outline[C] = reach / out.c;
        outline[LOP] = lop;
        outline[HALF_W] = half_w;
        outline[HALF_H] = half_h;
        if (!f.broad) {
            a = 1.0, b = 0.0, c = conditional = HALF_LOG2E / SPOT;
            plane.tilt_x = plane.tilt_y = 0.0;
        }
        // Along the ridge, from (u, v) to the image row nearest to it.
        const double along = plane.tilt_x * b / c + plane.tilt_y;
        float *tilt = tilts + (size_t)n * TILT_COLUMNS;
        tilt[Q0] = 1.0 + along * (MIN(MAX(v, 0.0), height) - v);
        tilt[QX] = plane.tilt_x;
        tilt[QY] = along;
        tilt[NEAREST] = f.broad ? near / p[2] : INFINITE;
        tilt[SPOT_U] = u;
        tilt[MIDDLE] = middle_v;
        for (int i = 0; i < 3; i++) tilt[NORMAL_X + i] = plane.normal[i];
    } else {
        half_w = sqrt(reach * a / HALF_LOG2E);
        half_h = sqrt(reach * c / HALF_LOG2E);
        largest = MAX(half_w, half_h);
    }
    // The tests are false for NaN and Inf.
    if (!(middle_u + half_w > 0.0 && middle_u - half_w < width && middle_v + half_h > 0.0 &&
          middle_v - half_h < height))
        return;
    if (!(largest < MAX_EXTENT)) return;
    const double dx = mx - view[20], dy = my - view[21], dz = mz - view[22];
    const double length = sqrt(dx * dx + dy * dy + dz * dz);
    double basis[COEFFICIENTS];
    sh_basis(dx / length, dy / length, dz / length, COEFFICIENTS, basis);
    bool finite = true;
    for (int channel = 0; channel < 3; channel++) {
        double value = 0.5;
        for (int k = 0; k < COEFFICIENTS; k++) value += basis[k] * sh[((size_t)n * COEFFICIENTS + k) * 3 + channel];
        finite = finite && fabs(value) < MAX_COLOR;
        splat[RED + channel] = MAX(value, 0.0);
    }
    if (!finite) return;
    splat[U] = u + b / c * (MIN(MAX(v, 0.0), height) - v);
    splat[V] = v;
    splat[SLOPE] = b / c;
    splat[A] = HALF_LOG2E / conditional;
    splat[C] = HALF_LOG2E / c;
    splat[LOP] = lop;
    splat[DEPTH] = p[2];
    splat[HALF_W] = half_w;
    splat[HALF_H] = half_h;
}
