// Generation of Gaussians from anchors and the outputs of the heads, one thread per offset; see generate.py.
//
// of_opacity (n, k), of_shape (n, 7 k), of_color (n, 3 K k): outputs of the heads; present (n,): anchors without it
// generate nothing. Every offset has an entry; `valid` is false for one without a Gaussian, whose opacity is 0.
#include "generate.h"

KERNEL(128, 1) generate(
    const float *positions, const int *anchor_ids, const float *rows, const float *of_opacity, const float *of_shape,
    const float *of_color, const bool *present, int count, float *means, float *quats, float *scales, float *opacities,
    float *sh, int *ids, bool *valid) {
    const int n = BLOCK * THREADS_OF_BLOCK + THREAD;
    if (n >= count) return;
    const int a = n / OFFSETS, j = n % OFFSETS;
    const size_t at = n;
    const float *row = rows + (size_t)a * ROW_COLUMNS;
    const float raw = of_opacity[at] + row[AT_OPACITY + j];
    const bool made = raw > (float)RAW_OPACITY_MIN && (!present || present[a]);
    valid[at] = made;
    ids[at] = anchor_ids[a];
    opacities[at] = made ? tanhf(raw) : 0.0f;
    for (int i = 0; i < 3; i++) {
        // NaN stays NaN.
        const float offset_extent = row[AT_EXTENTS + i], scale_extent = row[AT_EXTENTS + 3 + i];
        const float extent = expf(offset_extent > (float)LOG_EXTENT_MAX ? (float)LOG_EXTENT_MAX : offset_extent);
        const float size = expf(scale_extent > (float)LOG_EXTENT_MAX ? (float)LOG_EXTENT_MAX : scale_extent);
        means[3 * at + i] = positions[3 * (size_t)a + i] + row[3 * j + i] * extent;
        scales[3 * at + i] = size / (1.0f + expf(-(of_shape[7 * at + i] + row[AT_SHAPE + 7 * j + i])));
    }
    for (int i = 0; i < 4; i++) quats[4 * at + i] = of_shape[7 * at + 3 + i] + row[AT_SHAPE + 7 * j + 3 + i];
    for (int i = 0; i < 3 * COEFFICIENTS; i++) {
        const float color = of_color[3 * COEFFICIENTS * at + i];
        sh[3 * COEFFICIENTS * at + i] = i < 3 ? color + row[AT_COLOR + 3 * j + i] : color;
    }
}
