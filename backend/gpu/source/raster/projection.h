// Projection of 3D Gaussians and discs (FLAT): what both directions compute. For the formulas see splats.py and
// discs.py.
#ifndef PROJECTION_H
#define PROJECTION_H

#include "platform.h"
#include "spherical_harmonics.h"

struct Footprint {
    double R[3][3];            // rotation
    double T[2][3];            // Jacobian times rotation of the camera
    double V[2][3];            // T R diag(scales)
    double tx, ty;             // clamped tangents of the ray
    double a, b, c;            // V V^T (and the low-pass filter)
    double conditional;        // a - b^2 / c
    double area;               // of discs: the determinant of V
    bool broad;                // of discs: wide enough in the image for the plane to be drawn
};

// The plane of a disc: its normal towards the camera, 1 or -1 (its sign relative to the third column of R), the negative
// distance of the camera from the plane, and qx, qy.
struct Plane {
    double normal[3], side, distance, tilt_x, tilt_y;
};

DEVICE void transform(const double *view, double mx, double my, double mz, double *p) {
    for (int i = 0; i < 3; i++)
        p[i] = view[4 * i] * mx + view[4 * i + 1] * my + view[4 * i + 2] * mz + view[4 * i + 3];
}

DEVICE void rotate(double w, double x, double y, double z, double R[3][3]) {
    R[0][0] = 1.0 - 2.0 * (y * y + z * z);
    R[0][1] = 2.0 * (x * y - w * z);
    R[0][2] = 2.0 * (x * z + w * y);
    R[1][0] = 2.0 * (x * y + w * z);
    R[1][1] = 1.0 - 2.0 * (x * x + z * z);
    R[1][2] = 2.0 * (y * z - w * x);
    R[2][0] = 2.0 * (x * z - w * y);
    R[2][1] = 2.0 * (y * z + w * x);
    R[2][2] = 1.0 - 2.0 * (x * x + y * y);
}

// p: the position in camera space; q: the unit quaternion; scales: those of this splat.
DEVICE Footprint footprint_of(const double *view, const double *p, const double *q, const float *scales) {
    Footprint f;
    const double fx = view[12], fy = view[13], *limits = view + 16;
    rotate(q[0], q[1], q[2], q[3], f.R);
    f.tx = MIN(MAX(p[0] / p[2], limits[0]), limits[1]);
    f.ty = MIN(MAX(p[1] / p[2], limits[2]), limits[3]);
    for (int i = 0; i < 3; i++) {
        f.T[0][i] = fx / p[2] * (view[i] - f.tx * view[8 + i]);
        f.T[1][i] = fy / p[2] * (view[4 + i] - f.ty * view[8 + i]);
    }
    double a = 0.0, b = 0.0, c = 0.0;
    for (int j = 0; j < (FLAT ? 2 : 3); j++) {
        double scale = scales[j];
        for (int i = 0; i < 2; i++)
            f.V[i][j] = (f.T[i][0] * f.R[0][j] + f.T[i][1] * f.R[1][j] + f.T[i][2] * f.R[2][j]) * scale;
        a += f.V[0][j] * f.V[0][j];
        b += f.V[0][j] * f.V[1][j];
        c += f.V[1][j] * f.V[1][j];
    }
    double x, y, z = f.V[0][0] * f.V[1][1] - f.V[0][1] * f.V[1][0];
    f.b = b;
    if (FLAT) {
        f.a = a, f.c = c, f.area = z;
        f.broad = z * z > MIN_DISC_WIDTH * MIN_DISC_WIDTH * (a + c);
        f.conditional = f.broad ? z * z / c : 1.0;
    } else {
        // The determinant of V V^T is the squared area of the parallelogram spanned by V's rows; a c - b^2 would cancel
        // for diagonal needles.
        x = f.V[0][1] * f.V[1][2] - f.V[0][2] * f.V[1][1];
        y = f.V[0][2] * f.V[1][0] - f.V[0][0] * f.V[1][2];
        f.conditional = (x * x + y * y + z * z + EPS_2D * (a + c + EPS_2D)) / (c + EPS_2D);
        f.a = a + EPS_2D, f.c = c + EPS_2D;
    }
    return f;
}

DEVICE Plane plane_of(const double *view, const double *p, const double R[3][3]) {
    Plane plane;
    const double fx = view[12], fy = view[13];
    for (int i = 0; i < 3; i++)
        plane.normal[i] = view[4 * i] * R[0][2] + view[4 * i + 1] * R[1][2] + view[4 * i + 2] * R[2][2];
    plane.distance = p[0] * plane.normal[0] + p[1] * plane.normal[1] + p[2] * plane.normal[2];
    plane.side = 1.0;
    if (plane.distance > 0.0) {
        for (int i = 0; i < 3; i++) plane.normal[i] = -plane.normal[i];
        plane.side = -1.0;
        plane.distance = -plane.distance;
    }
    plane.tilt_x = p[2] * plane.normal[0] / (fx * plane.distance);
    plane.tilt_y = p[2] * plane.normal[1] / (fy * plane.distance);
    return plane;
}

#endif
