// Front-to-back blending of splats in tiles; one block per tile. LABELS, DEPTHS, MEDIAN, SURFACE, NORMALS, MOMENTS: whether
// these planes are wanted; the others are not accessed.
//
// isect_counts receives the number of intersections of each tile up to the last one that contributed.
#include "staging.h"

KERNEL(THREADS, 1) blend(
    const float *splats, const float *tilts, const int *ids, const int *labels, const long long *isect_offsets,
    const int *isect_ids, int columns, int width, int height, float *color, float *transmittance,
    float *label_probability, float *depth, float *median, float *surface, float *normals, float *moments,
    int *isect_counts) {
    SHARED(float, stage, [STAGED][STRIDE]);
    SHARED(int, owners, [STAGED]);
    SHARED(int, last_needed, [1]);
    const int thread = THREAD, tile = BLOCK;
    const int tile_x = tile % columns * TILE, tile_y = tile / columns * TILE;
    const int px = tile_x + column_of(thread), py = tile_y + line_of(thread);
    const float x = (float)column_of(thread), y = (float)py + 0.5f;
    const float warp_x = (float)column_of(thread - thread % WARP);
    const float warp_y = (float)(tile_y + line_of(thread - thread % WARP)) + 0.5f;
    const bool inside = px < width && py < height;
    const size_t pixel = (size_t)py * width + px, plane = (size_t)width * height;
    const int label = LABELS && inside ? labels[pixel] : -1;
    if (thread == 0) last_needed[0] = 0;
    float t = inside ? 1.0f : 0.0f;
    float red = 0.0f, green = 0.0f, blue = 0.0f, probability = 0.0f, z_sum = 0.0f, z_median = 0.0f, z_surface = 0.0f;
    float nx = 0.0f, ny = 0.0f, nz = 0.0f, m1 = 0.0f, m2 = 0.0f, origin = 0.0f;
    int needed = 0;
    const int first = (int)isect_offsets[tile], last = (int)isect_offsets[tile + 1];
    for (int base = first; base < last; base += STAGED) {
        if (!any_in_block(t >= (float)TRANSMITTANCE_THRESHOLD)) break;
        if (base + thread < last) {
            const int n = isect_ids[base + thread];
            owners[thread] = ids[n];
            stage_splat(splats, tilts, n, tile_x, height, stage[thread]);
        }
        sync_block();
        const int count = MIN(STAGED, last - base);
        // Each thread of a warp looks whether one of 32 splats may be drawn in the warp's pixels.
        for (int group = 0; group < count; group += WARP) {
            const int mine = group + thread % WARP;
            unsigned votes = votes_of_warp(mine < count && may_be_drawn(stage[mine], warp_x, warp_y));
            for (; votes && t >= (float)TRANSMITTANCE_THRESHOLD; votes &= votes - 1) {
                const int k = group + lowest_bit(votes);
                const float *row = stage[k];
                float q, per_q;
                const float exponent = exponent_of(row, x, y, &q, &per_q);
                if (!(exponent >= (float)LOG2_CUT)) continue;
                needed = base - first + k + 1;
                const float alpha = MIN(exp2f(exponent), (float)ALPHA_MAX);
                const float w = alpha * t, after = t * (1.0f - alpha);
                red += w * row[S_RED];
                green += w * row[S_GREEN];
                blue += w * row[S_BLUE];
                if (LABELS && owners[k] == label) probability += w;
#if DEPTHS || MEDIAN || SURFACE
                float z = row[S_DEPTH];
                if (FLAT && per_q > 0.0f) z *= per_q;
                if (DEPTHS) z_sum += w * z;
                if (MEDIAN && t >= 0.5f && after < 0.5f) z_median = z;
                if (SURFACE && t >= 0.5f) z_surface += w / (1.0f - after) * (z - z_surface);
#endif
#if NORMALS
                nx += w * row[S_NORMAL_X];
                ny += w * row[S_NORMAL_Y];
                nz += w * row[S_NORMAL_Z];
#endif
#if MOMENTS
                float inverse = row[PER_DEPTH] * q;
                if (t >= 1.0f) origin = inverse;
                inverse -= origin;
                m1 += w * inverse;
                m2 += w * inverse * inverse;
#endif
                t = after;
            }
        }
    }
    sync_block();
    largest_in_block(last_needed, needed);
    sync_block();
    if (thread == 0) isect_counts[tile] = last_needed[0];
    if (!inside) return;
    transmittance[pixel] = t;
    color[pixel] = red;
    color[plane + pixel] = green;
    color[2 * plane + pixel] = blue;
    if (LABELS) label_probability[pixel] = probability;
    if (DEPTHS) depth[pixel] = z_sum;
    if (MEDIAN) median[pixel] = z_median;
    if (SURFACE) surface[pixel] = z_surface;
    if (NORMALS) normals[pixel] = nx, normals[plane + pixel] = ny, normals[2 * plane + pixel] = nz;
    if (MOMENTS) moments[pixel] = m1, moments[plane + pixel] = m2;
}
