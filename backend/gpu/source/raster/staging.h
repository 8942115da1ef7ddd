// Splats staged in shared memory, and their log2 alpha in a pixel. A block of 256 threads draws a tile of 16x16 pixels,
// one thread per pixel; a warp draws 8x4 pixels.
#ifndef STAGING_H
#define STAGING_H

#include "platform.h"

#define THREADS (TILE * TILE)
#define COLUMNS_OF_WARP 8

// Columns of a staged splat: its column U relative to the tile, the row of its center, the row that U refers to, and the
// other values of a splat and, for discs, of a tilt. Rows are a multiple of 16 bytes, for loads of four values.
enum { AT_U, AT_V, ANCHOR, LEAN, ACROSS, DOWN, TOP, S_RED, S_GREEN, S_BLUE, S_DEPTH };
enum { S_Q0 = S_DEPTH + 1, S_QX, S_QY, S_NEAREST, S_SPOT_U, S_NORMAL_X, S_NORMAL_Y, S_NORMAL_Z, PER_DEPTH };
#define STRIDE (FLAT ? 20 : 12)

DEVICE void stage_splat(const float *splats, const float *tilts, int n, int tile_x, int height, float *row) {
    const float *splat = splats + (size_t)n * SPLAT_COLUMNS;
    row[AT_U] = splat[U] - 0.5f - (float)tile_x;
    row[AT_V] = splat[V];
    row[ANCHOR] = MIN(MAX(splat[V], 0.0f), (float)height);
    row[LEAN] = splat[SLOPE];
    row[ACROSS] = splat[A];
    row[DOWN] = splat[C];
    row[TOP] = splat[LOP];
    row[S_RED] = splat[RED];
    row[S_GREEN] = splat[GREEN];
    row[S_BLUE] = splat[BLUE];
    row[S_DEPTH] = splat[DEPTH];
#if FLAT
    const float *tilt = tilts + (size_t)n * TILT_COLUMNS;
    row[S_Q0] = tilt[Q0];
    row[S_QX] = tilt[QX];
    row[S_QY] = tilt[QY];
    row[S_NEAREST] = tilt[NEAREST];
    row[S_SPOT_U] = tilt[SPOT_U] - 0.5f - (float)tile_x;
    row[S_NORMAL_X] = tilt[NORMAL_X];
    row[S_NORMAL_Y] = tilt[NORMAL_Y];
    row[S_NORMAL_Z] = tilt[NORMAL_Z];
    row[PER_DEPTH] = 1.0f / splat[DEPTH];
#endif
}

// The horizontal distance of a pixel from the ridge of a splat, and the vertical distance from its center. x: the pixel's
// column in the tile; y: the row of its center in the image.
DEVICE void offsets(const float *row, float x, float y, float *d, float *dy) {
    *d = x - (row[AT_U] + row[LEAN] * (y - row[ANCHOR]));
    *dy = y - row[AT_V];
}

// Returns log2 alpha in a pixel, unclamped. Of discs, q: Q; per_q: 1 / Q where the plane is drawn, 0 where the spot is.
DEVICE float exponent_of(const float *row, float x, float y, float *q, float *per_q) {
    float d, dy;
    offsets(row, x, y, &d, &dy);
#if FLAT
    *q = row[S_Q0] + row[S_QY] * (y - row[ANCHOR]) + row[S_QX] * d;
    *per_q = reciprocal(*q);
    const float fall = (row[ACROSS] * d * d + row[DOWN] * dy * dy) * *per_q * *per_q;
    const float ds = x - row[S_SPOT_U];
    const float spot_fall = (float)SPOT * (ds * ds + dy * dy);
    // False if Q = 0, for which `fall` is NaN.
    if (*per_q >= row[S_NEAREST] && spot_fall > fall) return row[TOP] - fall;
    *q = 1.0f, *per_q = 0.0f;
    return row[TOP] - spot_fall;
#else
    return row[TOP] - row[DOWN] * dy * dy - row[ACROSS] * d * d;
#endif
}

// Whether a splat may be drawn in a pixel of a warp: in its rows, at most at the pixel nearest to the ridge, or to the
// spot of a disc. x, y: the pixel of the warp's first thread. The slack covers rounding.
DEVICE bool may_be_drawn(const float *row, float x, float y) {
    const float reach = row[TOP] - (float)LOG2_CUT + 0.1f;
    bool found = false;
    for (int line = 0; line < WARP / COLUMNS_OF_WARP; line++) {
        float left, right, dy;
        offsets(row, x, y + line, &left, &dy);
        right = left + (COLUMNS_OF_WARP - 1);
        const float d = left > 0.0f ? left : right < 0.0f ? right : 0.0f;
        const float fall = row[ACROSS] * d * d + row[DOWN] * dy * dy;
#if FLAT
        // Q is linear along the row.
        const float q = row[S_Q0] + row[S_QY] * (y + line - row[ANCHOR]);
        const float largest = MAX(fabsf(q + row[S_QX] * left), fabsf(q + row[S_QX] * right));
        const float from = x - row[S_SPOT_U], to = from + (COLUMNS_OF_WARP - 1);
        const float ds = from > 0.0f ? from : to < 0.0f ? to : 0.0f;
        found = found || fall <= reach * largest * largest || (float)SPOT * (ds * ds + dy * dy) <= reach;
#else
        found = found || fall <= reach;
#endif
    }
    return found;
}

DEVICE int column_of(int thread) { return thread % WARP % 8 + thread / WARP % 2 * 8; }
DEVICE int line_of(int thread) { return thread % WARP / 8 + thread / WARP / 2 * 4; }

#endif
