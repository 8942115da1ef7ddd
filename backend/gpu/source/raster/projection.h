// Projection of 3D Gaussians and discs (FLAT): what both directions compute. For the formulas see splats.py and
// discs.py.
//
// Positions, the footprint and the plane of a disc are computed in double, where determinants would cancel in float, with
// few divisions and no roots, since many GPUs are slow in double. All that follows from them is float.
#ifndef PROJECTION_H
#define PROJECTION_H

#include "platform.h"
#include "spherical_harmonics.h"

#define AXES (FLAT ? 2 : 3)

// The plane of a disc: its normal towards the camera, 1 or -1 (its sign relative to the third column of R), the negative
// distance of the camera from the plane, and qx, qy.
struct Plane {
    double normal[3], side, distance, tilt_x, tilt_y;
};

struct Footprint {
    double p[3], per_z;        // position in camera space, and 1 / depth
    double tx, ty;             // clamped tangents of the ray
    double R[3][3];            // rotation
    double T[2][3];            // Jacobian times rotation of the camera
    double V[2][3];            // T R diag(scales)
    double a, b, c;            // V V^T (and the low-pass filter)
    double slope, conditional; // b / c, a - b^2 / c
    double area;               // of discs: the determinant of V
    bool broad;                // of discs: wide enough in the image for the plane to be drawn
};

// Writes the position in camera space.
DEVICE void transform(const double *view, const float *mean, double *p) {
    for (int i = 0; i < 3; i++)
        p[i] = view[4 * i] * mean[0] + view[4 * i + 1] * mean[1] + view[4 * i + 2] * mean[2] + view[4 * i + 3];
}

// q: a quaternion of any length.
DEVICE void rotate(const float *q, double R[3][3]) {
    const double w = q[0], x = q[1], y = q[2], z = q[3], twice = 2.0 / (w * w + x * x + y * y + z * z);
    const double sx = twice * x, sy = twice * y, sz = twice * z;
    R[0][0] = 1.0 - (sy * y + sz * z);
    R[0][1] = sx * y - sz * w;
    R[0][2] = sx * z + sy * w;
    R[1][0] = sx * y + sz * w;
    R[1][1] = 1.0 - (sx * x + sz * z);
    R[1][2] = sy * z - sx * w;
    R[2][0] = sx * z - sy * w;
    R[2][1] = sy * z + sx * w;
    R[2][2] = 1.0 - (sx * x + sy * y);
}

// mean, quat, scales: those of this splat.
DEVICE Footprint footprint_of(const double *view, const float *mean, const float *quat, const float *scales) {
    Footprint f;
    const double *limits = view + 16;
    transform(view, mean, f.p);
    rotate(quat, f.R);
    f.per_z = 1.0 / f.p[2];
    f.tx = MIN(MAX(f.p[0] * f.per_z, limits[0]), limits[1]);
    f.ty = MIN(MAX(f.p[1] * f.per_z, limits[2]), limits[3]);
    const double fx_z = view[12] * f.per_z, fy_z = view[13] * f.per_z;
    for (int i = 0; i < 3; i++) {
        f.T[0][i] = fx_z * (view[i] - f.tx * view[8 + i]);
        f.T[1][i] = fy_z * (view[4 + i] - f.ty * view[8 + i]);
    }
    double a = 0.0, b = 0.0, c = 0.0;
    for (int j = 0; j < AXES; j++) {
        const double scale = scales[j];
        for (int i = 0; i < 2; i++)
            f.V[i][j] = (f.T[i][0] * f.R[0][j] + f.T[i][1] * f.R[1][j] + f.T[i][2] * f.R[2][j]) * scale;
        a += f.V[0][j] * f.V[0][j];
        b += f.V[0][j] * f.V[1][j];
        c += f.V[1][j] * f.V[1][j];
    }
    // The determinant of V V^T is the squared area of the parallelogram spanned by V's rows; a c - b^2 would cancel for
    // diagonal needles.
    f.area = f.V[0][0] * f.V[1][1] - f.V[0][1] * f.V[1][0];
    double square = f.area * f.area;
    f.broad = square > MIN_DISC_WIDTH * MIN_DISC_WIDTH * (a + c);
#if !FLAT
    const double x = f.V[0][1] * f.V[1][2] - f.V[0][2] * f.V[1][1];
    const double y = f.V[0][2] * f.V[1][0] - f.V[0][0] * f.V[1][2];
    const double blur = view[24];
    square += x * x + y * y + blur * (a + c + blur);
    a += blur, c += blur;
#endif
    const double per_c = 1.0 / c;
    f.a = a, f.b = b, f.c = c;
    f.slope = b * per_c;
    f.conditional = square * per_c;
    if (FLAT && !f.broad) f.slope = 0.0, f.conditional = 1.0;
    return f;
}

DEVICE Plane plane_of(const double *view, const Footprint &f) {
    Plane plane;
    for (int i = 0; i < 3; i++)
        plane.normal[i] = view[4 * i] * f.R[0][2] + view[4 * i + 1] * f.R[1][2] + view[4 * i + 2] * f.R[2][2];
    plane.distance = f.p[0] * plane.normal[0] + f.p[1] * plane.normal[1] + f.p[2] * plane.normal[2];
    plane.side = 1.0;
    if (plane.distance > 0.0) {
        for (int i = 0; i < 3; i++) plane.normal[i] = -plane.normal[i];
        plane.side = -1.0;
        plane.distance = -plane.distance;
    }
    const double per_distance = f.p[2] / plane.distance;
    plane.tilt_x = per_distance * plane.normal[0] / view[12];
    plane.tilt_y = per_distance * plane.normal[1] / view[13];
    return plane;
}

#endif
