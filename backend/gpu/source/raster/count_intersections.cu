// Number of tiles that each splat intersects, from near to far.
#include "binning.h"

KERNEL(128, 1) count_intersections(
    const float *outlines, const long long *keys, const long long *order, int count, int columns, int lines, int height,
    long long *counts) {
    const int i = BLOCK * THREADS_OF_BLOCK + THREAD;
    if (i >= count) return;
    int met = 0;
    if (keys[i] != UNSEEN) {
        const float *outline = outlines + order[i] * SPLAT_COLUMNS;
        int top, bottom, first, last;
        tile_rows(outline, lines, &top, &bottom);
        for (int row = top; row < bottom; row++) {
            row_ends(outline, row, columns, height, &first, &last);
            met += MAX(last - first, 0);
        }
    }
    counts[i] = met;
}
