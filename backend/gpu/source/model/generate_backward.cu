// Gradient of the generation: from those of the Gaussians to those of the rows, except for their features, and of the
// outputs of the heads. Gradients that are not given are 0. A block processes ANCHORS_PER_BLOCK anchors, with a thread for each of their offsets.
#include "generate.h"

#define ANCHORS_PER_BLOCK (THREADS_OF_GENERATE / OFFSETS)

KERNEL(THREADS_OF_GENERATE, 1) generate_backward(
    const float *rows, const float *scales, const float *opacities, const bool *valid, const float *g_means,
    const float *g_quats, const float *g_scales, const float *g_opacities, const float *g_sh, int anchors, float *g_rows,
    float *g_of_opacity, float *g_of_shape, float *g_of_color) {
    SHARED(float, of_extents, [THREADS_OF_GENERATE][6]);
    const int member = THREAD / OFFSETS, j = THREAD % OFFSETS;
    const int first = BLOCK * ANCHORS_PER_BLOCK, a = first + member;
    if (member < ANCHORS_PER_BLOCK && a < anchors) {
        const size_t at = (size_t)a * OFFSETS + j;
        const float *row = rows + (size_t)a * ROW_COLUMNS;
        float *g_row = g_rows + (size_t)a * ROW_COLUMNS;
        const bool made = valid[at];
        const float alpha = opacities[at];
        const float g_raw = made && g_opacities ? g_opacities[at] * (1.0f - alpha * alpha) : 0.0f;
        g_of_opacity[at] = g_row[AT_OPACITY + j] = g_raw;
        for (int i = 0; i < 3; i++) {
            const float offset_extent = row[AT_EXTENTS + i], scale_extent = row[AT_EXTENTS + 3 + i];
            const float extent = expf(offset_extent > (float)LOG_EXTENT_MAX ? (float)LOG_EXTENT_MAX : offset_extent);
            const float size = expf(scale_extent > (float)LOG_EXTENT_MAX ? (float)LOG_EXTENT_MAX : scale_extent);
            const float g_mean = made && g_means ? g_means[3 * at + i] : 0.0f;
            const float along = made && g_scales ? g_scales[3 * at + i] * scales[3 * at + i] : 0.0f;
            // The clamp of the extents passes the gradient, so that one beyond the limit can return.
            g_row[3 * j + i] = g_mean * extent;
            of_extents[THREAD][i] = g_mean * row[3 * j + i] * extent;
            of_extents[THREAD][3 + i] = along;
            const float g_size = made ? along * (1.0f - scales[3 * at + i] / size) : 0.0f;
            g_of_shape[7 * at + i] = g_row[AT_SHAPE + 7 * j + i] = g_size;
        }
        for (int i = 0; i < 4; i++)
            g_of_shape[7 * at + 3 + i] = g_row[AT_SHAPE + 7 * j + 3 + i] = made && g_quats ? g_quats[4 * at + i] : 0.0f;
        for (int i = 0; i < 3 * COEFFICIENTS; i++) {
            const float g = made && g_sh ? g_sh[3 * COEFFICIENTS * at + i] : 0.0f;
            g_of_color[3 * COEFFICIENTS * at + i] = g;
            if (i < 3) g_row[AT_COLOR + 3 * j + i] = g;
        }
    }
    sync_block();
    for (int i = THREAD; i < 6 * ANCHORS_PER_BLOCK; i += THREADS_OF_BLOCK) {
        const int of = i / 6, column = i % 6;
        if (first + of >= anchors) break;
        float sum = 0.0f;
        for (int k = 0; k < OFFSETS; k++) sum += of_extents[of * OFFSETS + k][column];
        g_rows[(size_t)(first + of) * ROW_COLUMNS + AT_EXTENTS + column] = sum;
    }
}
