// The tiles that each splat intersects, from near to far, as far as the capacity allows; and each splat's gradient rows.
#include "binning.h"

KERNEL(128, 1) write_intersections(
    const float *outlines, const long long *order, const long long *counts, const long long *cumulative, int count,
    int columns, int lines, int height, long long capacity, TILE_ID *tile_ids, int *splat_ids, long long *first_rows,
    long long *last_rows) {
    const int i = BLOCK * THREADS_OF_BLOCK + THREAD;
    if (i >= count) return;
    const long long n = order[i], start = cumulative[i] - counts[i], end = MIN(cumulative[i], capacity);
    long long row_id = MIN(start, capacity);
    first_rows[n] = last_rows[n] = row_id;
    if (!counts[i]) return;
    const float *outline = outlines + n * SPLAT_COLUMNS;
    int top, bottom, first, last;
    tile_rows(outline, lines, &top, &bottom);
    for (int row = top; row < bottom; row++) {
        row_ends(outline, row, columns, height, &first, &last);
        // Rounding may be another than when the tiles were counted.
        for (int column = first; column < last && row_id < end; column++, row_id++) {
            tile_ids[row_id] = (TILE_ID)(row * columns + column);
            splat_ids[row_id] = (int)n;
        }
    }
    last_rows[n] = row_id;
}
