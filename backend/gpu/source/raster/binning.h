// Tiles that a splat's ellipse intersects, and sort keys; see tile_intersection.py and binning.py.
#ifndef BINNING_H
#define BINNING_H

#include "platform.h"

#define UNSEEN 0x7fffffffffffffffLL

// Of values beyond any image, the nearest that an int can hold.
DEVICE int floor_of(float x) {
    x = MIN(MAX(x, -1e9f), 1e9f);
    int whole = (int)x;
    return (float)whole > x ? whole - 1 : whole;
}

// Writes the first and last + 1 tile column that the ellipse overlaps in tile row `row`.
DEVICE void row_ends(const float *splat, int row, int columns, int height, int *first, int *last) {
    const float per_tile = 1.0f / TILE;
    const float v = splat[V], slope = splat[SLOPE], half_w = splat[HALF_W], half_h = splat[HALF_H];
    const float anchor = MIN(MAX(v, 0.0f), (float)height);
    const float u = splat[U] + slope * (v - anchor);
    const int box_first = MAX(floor_of((u - half_w - 0.5f) * per_tile), 0);
    const int box_last = MIN(floor_of((u + half_w + 0.5f) * per_tile) + 1, columns);
    *first = box_first, *last = box_last;
    if (box_last - box_first < 2) return;
    const float top = MAX((float)(row * TILE), v - half_h);
    const float bottom = MIN((float)((row + 1) * TILE), v + half_h);
    // The rightmost point of the ellipse lies at y = v + peak, the leftmost at v - peak; elsewhere the span is narrower.
    const float reach = splat[LOP] - (float)LOG2_CUT;
    const float peak = slope * reach / (splat[C] * half_w);
    float y = MIN(MAX(v + peak, top), bottom);
    float half = sqrtf(MAX(reach - splat[C] * (y - v) * (y - v), 0.0f) / splat[A]);
    const float right = splat[U] + slope * (y - anchor) + half;
    y = MIN(MAX(v - peak, top), bottom);
    half = sqrtf(MAX(reach - splat[C] * (y - v) * (y - v), 0.0f) / splat[A]);
    const float left = splat[U] + slope * (y - anchor) - half;
    *first = MAX(floor_of((left - 0.5f) * per_tile), box_first);
    *last = MIN(floor_of((right + 0.5f) * per_tile) + 1, box_last);
}

// Writes the first and last + 1 tile row that the splat's bounding box overlaps.
DEVICE void tile_rows(const float *splat, int lines, int *first, int *last) {
    const float per_tile = 1.0f / TILE;
    *first = MAX(floor_of((splat[V] - splat[HALF_H]) * per_tile), 0);
    *last = MIN(floor_of((splat[V] + splat[HALF_H]) * per_tile) + 1, lines);
}

#endif
