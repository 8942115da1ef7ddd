// The first intersection of each tile, and the splat of each intersection, from the intersections sorted by tile.
//
// tile_ids: of the sorted intersections, `tiles` where there is none; rows: their places before sorting.
#include "platform.h"

KERNEL(128, 1) find_tiles(
    const TILE_ID *tile_ids, const long long *rows, const int *splat_ids, int tiles, int capacity,
    long long *isect_offsets, int *isect_ids) {
    const int i = BLOCK * THREADS_OF_BLOCK + THREAD;
    if (i >= capacity) return;
    const int tile = tile_ids[i], before = i ? tile_ids[i - 1] : -1;
    for (int t = before + 1; t <= tile; t++) isect_offsets[t] = i;
    if (i == capacity - 1)
        for (int t = tile + 1; t <= tiles; t++) isect_offsets[t] = capacity;
    isect_ids[i] = tile < tiles ? splat_ids[rows[i]] : 0;
}
