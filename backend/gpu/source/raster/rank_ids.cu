// The most probable objects of each pixel; see ids.py. names: the ID of each (tile, ID) pair; bounds: the first pair of
// each tile; slots: the pair of each intersection.
#include "staging.h"

KERNEL(THREADS, 1) rank_ids(
    const float *splats, const float *tilts, const int *slots, const int *names, const int *bounds,
    const long long *isect_offsets, const int *isect_ids, const int *isect_counts, int columns, int width, int height,
    int ranks, int *best_id, float *best_probability) {
    SHARED(float, stage, [STAGED_IDS][STRIDE]);
    SHARED(int, staged_slots, [STAGED_IDS]);
    SHARED(float, sums, [SLOTS][THREADS]);
    const int thread = THREAD, tile = BLOCK;
    const int tile_x = tile % columns * TILE, tile_y = tile / columns * TILE;
    const int px = tile_x + column_of(thread), py = tile_y + line_of(thread);
    const float x = (float)column_of(thread), y = (float)py + 0.5f;
    const bool inside = px < width && py < height;
    const size_t pixel = (size_t)py * width + px, plane = (size_t)width * height;
    const int first = (int)isect_offsets[tile], last = first + isect_counts[tile];
    for (int lowest = bounds[tile]; lowest < bounds[tile + 1]; lowest += SLOTS) {
        const int count = MIN(SLOTS, bounds[tile + 1] - lowest);
        for (int slot = 0; slot < count; slot++) sums[slot][thread] = 0.0f;
        float t = inside ? 1.0f : 0.0f;
        for (int base = first; base < last; base += STAGED_IDS) {
            sync_block();
            const int here = MIN(STAGED_IDS, last - base);
            if (thread < here) {
                staged_slots[thread] = slots[base + thread];
                stage_splat(splats, tilts, isect_ids[base + thread], tile_x, height, stage[thread]);
            }
            sync_block();
            for (int k = 0; k < here && t >= (float)TRANSMITTANCE_THRESHOLD; k++) {
                float q, per_q;
                const float exponent = exponent_of(stage[k], x, y, &q, &per_q);
                if (!(exponent >= (float)LOG2_CUT)) continue;
                const float alpha = MIN(exp2f(exponent), (float)ALPHA_MAX);
                const int slot = staged_slots[k] - lowest;
                if (slot >= 0 && slot < SLOTS) sums[slot][thread] += alpha * t;
                t *= 1.0f - alpha;
            }
        }
        if (!inside) continue;
        // Of equal sums, the first one is ranked first.
        for (int slot = 0; slot < count; slot++) {
            const float weight = sums[slot][thread];
            int place = ranks;
            while (place > 0 && weight > best_probability[(place - 1) * plane + pixel]) place--;
            if (place == ranks) continue;
            for (int i = ranks - 1; i > place; i--) {
                best_probability[i * plane + pixel] = best_probability[(i - 1) * plane + pixel];
                best_id[i * plane + pixel] = best_id[(i - 1) * plane + pixel];
            }
            best_probability[place * plane + pixel] = weight;
            best_id[place * plane + pixel] = names[lowest + slot];
        }
    }
}
