// Gradient of the blending: writes the gradient row (splats.py) of each intersection i to rows[isect_rows[i]].
//
// The gradient of a splat is a sum over pixels. A reduction across a warp for each splat would dominate the run time, so
// eight splats are processed together, one per warp. In the first phase, each thread corresponds to a pixel: it visits
// the eight splats and writes their blending weights w and dL/d(log2 alpha) to shared memory. In the second phase, each
// warp corresponds to a splat: its lanes visit the pixels with sums in registers, which leaves only 32 partial sums. No
// two threads add to the same address, so the result is deterministic.
#include "staging.h"

#define WARPS (THREADS / WARP)
// Rows of `pixels`: the gradients of a pixel, kept for the second phase.
#define AT_DEPTH 3
#define AT_NORMALS (AT_DEPTH + DEPTHS)
#define AT_MOMENTS (AT_NORMALS + 3 * NORMALS)
#define AT_ORIGIN (AT_MOMENTS + 2)
#define KEPT (AT_MOMENTS + 3 * MOMENTS)
// A splat's part of shared memory: in the first phase w, the slope and, for discs, 1 / Q of each pixel; later the sums of
// each lane, with a padding of one number, so that 32 columns lie in 32 different banks.
#define KINDS (FLAT ? 3 : 2)
#define SPLAT_FLOATS MAX(KINDS *THREADS, COLUMNS *(WARP + 1))

struct Pixel {
    int thread, label;
    unsigned long long votes;  // of the staged splats that may be drawn in the pixels of the warp
    float x, y, t, remaining, g_alpha, g_label_probability;
};

// First phase, one pixel per thread: writes w, slope and 1 / Q of the splats in `count` staged rows from `base` on to
// `weights`; hits marks those that are drawn in this warp.
DEVICE void weigh(
    const float (*stage)[STRIDE], const int *owners, int base, int count, float (*pixels)[THREADS],
    float (*weights)[SPLAT_FLOATS], signed char (*hits)[WARPS], Pixel &at) {
    const int thread = at.thread;
    const float g_red = pixels[0][thread], g_green = pixels[1][thread], g_blue = pixels[2][thread];
    if (thread % WARP < count) hits[thread % WARP][thread / WARP] = 0;
    sync_warp();
    for (unsigned votes = (unsigned)(at.votes >> base) & ((1u << WARPS) - 1); votes; votes &= votes - 1) {
        const int s = lowest_bit(votes);
        const float *row = stage[base + s];
        float q = 1.0f, per_q = 0.0f;
        const float exponent = exponent_of(row, at.x, at.y, &q, &per_q);
        const bool drawn = exponent >= (float)LOG2_CUT && at.t >= (float)TRANSMITTANCE_THRESHOLD;
        const bool hit = any_in_warp(drawn);
        if (!hit) continue;
        if (thread % WARP == 0) hits[s][thread / WARP] = 1;
        float w = 0.0f, slope = 0.0f;
        if (drawn) {
            const float raw = exp2f(exponent);
            const float alpha = MIN(raw, (float)ALPHA_MAX);
            w = alpha * at.t;
            float dot = g_red * row[S_RED] + g_green * row[S_GREEN] + g_blue * row[S_BLUE] + at.g_alpha;
            if (LABELS && owners[base + s] == at.label) dot += at.g_label_probability;
#if DEPTHS
            float z = row[S_DEPTH];
            if (FLAT && per_q > 0.0f) z *= per_q;
            dot += pixels[AT_DEPTH][thread] * z;
#endif
#if NORMALS
            dot += pixels[AT_NORMALS][thread] * row[S_NORMAL_X] + pixels[AT_NORMALS + 1][thread] * row[S_NORMAL_Y] +
                   pixels[AT_NORMALS + 2][thread] * row[S_NORMAL_Z];
#endif
#if MOMENTS
            float inverse = row[PER_DEPTH] * q;
            if (at.t >= 1.0f) pixels[AT_ORIGIN][thread] = inverse;
            inverse -= pixels[AT_ORIGIN][thread];
            dot += inverse * (pixels[AT_MOMENTS][thread] + inverse * pixels[AT_MOMENTS + 1][thread]);
#endif
            const float clear = 1.0f - alpha;
            at.remaining -= w * dot;
            // A clamped alpha has no gradient; otherwise alpha is the derivative of the exponential.
            if (raw <= (float)ALPHA_MAX) slope = alpha * (at.t * dot - at.remaining * reciprocal(clear));
            at.t *= clear;
        }
        weights[s][thread] = w;
        weights[s][THREADS + thread] = slope;
#if FLAT
        weights[s][2 * THREADS + thread] = per_q;
#endif
    }
}

// Second phase, one splat per warp: sums the gradient row of a staged splat over the pixels of this lane.
DEVICE void add_up(
    const float *row, int lane, int tile_y, int warps, const float (*pixels)[THREADS], const float *weights,
    const signed char *hits, float *sums) {
    float m0 = 0.0f, my = 0.0f, myy = 0.0f, mx = 0.0f, mxy = 0.0f, mxx = 0.0f;
    float red = 0.0f, green = 0.0f, blue = 0.0f, depth = 0.0f;
    float mq = 0.0f, mqx = 0.0f, mqy = 0.0f, msx = 0.0f, msy = 0.0f, nx = 0.0f, ny = 0.0f, nz = 0.0f;
    for (int warp = 0; warp < warps; warp++) {
        if (!hits[warp]) continue;
        const int thread = warp * WARP + lane;
        const float x = (float)column_of(thread), y = (float)(tile_y + line_of(thread)) + 0.5f;
        float d, dy;
        offsets(row, x, y, &d, &dy);
        const float w = weights[thread];
        float slope = weights[THREADS + thread];
        red += w * pixels[0][thread];
        green += w * pixels[1][thread];
        blue += w * pixels[2][thread];
        m0 += slope;
#if FLAT
        const float per_q = weights[2 * THREADS + thread];
        const bool plane = per_q > 0.0f;
        float g_q = 0.0f, q = 1.0f;
        if (plane) q = row[S_Q0] + row[S_QY] * (y - row[ANCHOR]) + row[S_QX] * d;
#if DEPTHS
        float of_depth = w * pixels[AT_DEPTH][thread];
        if (plane) {
            of_depth *= per_q;
            g_q -= of_depth * row[S_DEPTH] * per_q;
        }
        depth += of_depth;
#endif
#if MOMENTS
        const float inverse = row[PER_DEPTH] * q;
        float of_inverse = pixels[AT_MOMENTS + 1][thread] * (inverse - pixels[AT_ORIGIN][thread]);
        of_inverse = w * row[PER_DEPTH] * (pixels[AT_MOMENTS][thread] + 2.0f * of_inverse);
        depth -= of_inverse * inverse;
        if (plane) g_q += of_inverse;
#endif
#if NORMALS
        nx += w * pixels[AT_NORMALS][thread];
        ny += w * pixels[AT_NORMALS + 1][thread];
        nz += w * pixels[AT_NORMALS + 2][thread];
#endif
        if (plane) {
            const float fall = (row[ACROSS] * d * d + row[DOWN] * dy * dy) * per_q * per_q;
            slope *= per_q;
            g_q += (float)(2.0 * LN2) * fall * slope;
            mq += g_q;
            mqx += g_q * d;
            mqy += g_q * dy;
            slope *= per_q;
        } else {
            msx += slope * (x - row[S_SPOT_U]);
            msy += slope * dy;
            slope = 0.0f;
        }
#elif DEPTHS
        depth += w * pixels[AT_DEPTH][thread];
#endif
        float along = slope * dy;
        my += along;
        myy += along * dy;
        along = slope * d;
        mx += along;
        mxy += along * dy;
        mxx += along * d;
    }
    const float ln2 = (float)LN2;
    sums[M0] = m0 * ln2, sums[MY] = my * ln2, sums[MYY] = myy * ln2;
    sums[MX] = mx * ln2, sums[MXY] = mxy * ln2, sums[MXX] = mxx * ln2;
    sums[G_RED] = red, sums[G_GREEN] = green, sums[G_BLUE] = blue, sums[G_DEPTH] = depth;
#if FLAT
    sums[MQ] = mq, sums[MQX] = mqx, sums[MQY] = mqy, sums[MSX] = msx * ln2, sums[MSY] = msy * ln2;
#endif
#if NORMALS
    sums[G_NORMAL - 1] = 0.0f;
    sums[G_NORMAL] = nx, sums[G_NORMAL + 1] = ny, sums[G_NORMAL + 2] = nz;
#endif
}

// A limit of registers that allows this number of blocks per multiprocessor causes no spilling.
KERNEL(THREADS, FLAT ? 3 : 4) blend_backward(
    const float *splats, const float *tilts, const int *ids, const int *labels, const long long *isect_offsets,
    const int *isect_ids, const long long *isect_rows, const int *isect_counts, int columns, int width, int height,
    const float *color, const float *transmittance, const float *label_probability, const float *depth,
    const float *normals, const float *moments, const float *g_color, const float *g_alpha,
    const float *g_label_probability, const float *g_depth, const float *g_normals, const float *g_moments,
    float *rows) {
    SHARED(float, stage, [STAGED_BACKWARD][STRIDE]);
    SHARED(int, owners, [STAGED_BACKWARD]);
    SHARED(float, pixels, [KEPT][THREADS]);
    SHARED(float, weights, [WARPS][SPLAT_FLOATS]);
    SHARED(signed char, hits, [WARPS][WARPS]);
    const int thread = THREAD, tile = BLOCK, warp = thread / WARP, lane = thread % WARP;
    // Not a compile-time constant, since the unrolled loop over the warps would need too many registers.
    const int warps = THREADS_OF_BLOCK / WARP;
    const int tile_x = tile % columns * TILE, tile_y = tile / columns * TILE;
    const int px = tile_x + column_of(thread), py = tile_y + line_of(thread);
    const size_t pixel = (size_t)py * width + px, plane = (size_t)width * height;
    const float warp_x = (float)column_of(warp * WARP), warp_y = (float)(tile_y + line_of(warp * WARP)) + 0.5f;
    Pixel at = {thread, -1, 0, (float)column_of(thread), (float)py + 0.5f, 0.0f, 0.0f, 0.0f, 0.0f};
    for (int i = 0; i < KEPT; i++) pixels[i][thread] = 0.0f;
    if (px < width && py < height) {
        at.t = 1.0f;
        at.g_alpha = g_alpha[pixel];
        at.remaining = (1.0f - transmittance[pixel]) * at.g_alpha;
        for (int i = 0; i < 3; i++) {
            pixels[i][thread] = g_color[i * plane + pixel];
            at.remaining += color[i * plane + pixel] * g_color[i * plane + pixel];
        }
        if (LABELS) {
            at.label = labels[pixel];
            at.g_label_probability = g_label_probability[pixel];
            at.remaining += label_probability[pixel] * at.g_label_probability;
        }
#if DEPTHS
        pixels[AT_DEPTH][thread] = g_depth[pixel];
        at.remaining += depth[pixel] * g_depth[pixel];
#endif
#if NORMALS
        for (int i = 0; i < 3; i++) {
            pixels[AT_NORMALS + i][thread] = g_normals[i * plane + pixel];
            at.remaining += normals[i * plane + pixel] * g_normals[i * plane + pixel];
        }
#endif
#if MOMENTS
        for (int i = 0; i < 2; i++) {
            pixels[AT_MOMENTS + i][thread] = g_moments[i * plane + pixel];
            at.remaining += moments[i * plane + pixel] * g_moments[i * plane + pixel];
        }
#endif
    }
    const int first = (int)isect_offsets[tile], last = (int)isect_offsets[tile + 1];
    const int end = first + isect_counts[tile];
    for (int base = first; base < end; base += STAGED_BACKWARD) {
        const int here = MIN(STAGED_BACKWARD, end - base);
        if (thread < here) {
            const int n = isect_ids[base + thread];
            owners[thread] = ids[n];
            stage_splat(splats, tilts, n, tile_x, height, stage[thread]);
        }
        sync_block();
        at.votes = 0;
        for (int group = 0; group < here; group += WARP) {
            const int mine = group + lane;
            const bool may = mine < here && may_be_drawn(stage[mine], warp_x, warp_y);
            at.votes |= (unsigned long long)votes_of_warp(may) << group;
        }
        for (int k = 0; k < here; k += WARPS) {
            weigh(stage, owners, k, MIN(WARPS, here - k), pixels, weights, hits, at);
            sync_block();
            float sums[COLUMNS];
            if (k + warp < here)
                add_up(stage[k + warp], lane, tile_y, warps, pixels, weights[warp], hits[warp], sums);
            sync_warp();
            if (k + warp < here)
                for (int column = 0; column < COLUMNS; column++) weights[warp][column * (WARP + 1) + lane] = sums[column];
            sync_warp();
            if (k + warp < here && lane < COLUMNS) {
                // In a fixed order.
                float even = 0.0f, odd = 0.0f;
                for (int i = 0; i < WARP; i += 2) {
                    even += weights[warp][lane * (WARP + 1) + i];
                    odd += weights[warp][lane * (WARP + 1) + i + 1];
                }
                rows[isect_rows[base + k + warp] * ROW + lane] = even + odd;
            }
            sync_block();
        }
    }
    for (int isect = end + warp; isect < last; isect += WARPS)
        if (lane < COLUMNS) rows[isect_rows[isect] * ROW + lane] = 0.0f;
}
