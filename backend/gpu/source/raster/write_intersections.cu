// The tiles that each splat intersects, from near to far, as far as the capacity allows; and each splat's gradient rows.
#include "binning.h"

KERNEL(128, 1) write_intersections(
    const float *outlines, const long long *order, const long long *counts, const long long *cumulative, int count,
    int columns, int lines, int height, long long capacity, TILE_ID *tile_ids, int *splat_ids, long long *first_rows,
    long long *last_rows) {
    const int i = BLOCK * THREADS_OF_BLOCK + THREAD;
    if (i >= count) return;
    const long long n = order[i];
    long long row_id = cumulative[i] - counts[i];
    first_rows[n] = MIN(row_id, capacity);
    last_rows[n] = MIN(cumulative[i], capacity);
    if (!counts[i]) return;
    const float *outline = outlines + n * SPLAT_COLUMNS;
    int top, bottom, first, last;
    tile_rows(outline, lines, &top, &bottom);
    for (int row = top; row < bottom; row++) {
        row_ends(outline, row, columns, height, &first, &last);
        for (int column = first; column < last; column++, row_id++) {
            if (row_id >= capacity) return;
            tile_ids[row_id] = (TILE_ID)(row * columns + column);
            splat_ids[row_id] = (int)n;
        }
    }
}
