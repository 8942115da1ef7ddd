// Sums of the image loss over each tile: |difference| and SSIM over pixels and channels, the logarithms of the labels'
// probabilities, and the number of labeled pixels. See on_cpu.py.
//
// planes (9, H, W): for each channel, the gradients of the mean SSIM with respect to the blurred picture, its blurred
// square and its blurred product with the target; unused without SSIM.
#include "image_loss.h"

KERNEL(THREADS, 1) image_loss(
    const float *color, const float *alpha, const float *label_probability, const float *background,
    const float *target, const int *labels, int width, int height, float *planes, float *sums) {
    SHARED(float, scratch, [THREADS]);
    const int across = (width + TILE - 1) / TILE;
    const int left = BLOCK % across * TILE, top = BLOCK / across * TILE;
    const int x = left + THREAD % TILE, y = top + THREAD / TILE;
    const bool inside = x < width && y < height;
    const size_t plane = (size_t)width * height, pixel = (size_t)y * width + x;
    float difference = 0.0f, similarity = 0.0f, of_labels = 0.0f, labeled = 0.0f;
    for (int c = 0; c < 3; c++) {
        if (inside) difference += fabsf(shown(color, alpha, background, c, plane, pixel) - target[c * plane + pixel]);
#if SSIM
        SHARED(float, patch, [5][PATCH][PATCH]);
        SHARED(float, between, [5][PATCH][TILE]);
        sync_block();
        for (int i = THREAD; i < PATCH * PATCH; i += THREADS) {
            const int u = left + i % PATCH - MARGIN, v = top + i / PATCH - MARGIN;
            const bool there = u >= 0 && u < width && v >= 0 && v < height;
            const size_t at = (size_t)v * width + u;
            const float a = there ? shown(color, alpha, background, c, plane, at) : 0.0f;
            const float b = there ? target[c * plane + at] : 0.0f;
            float *first = &patch[0][i / PATCH][i % PATCH];
            first[0] = a, first[PATCH * PATCH] = b;
            first[2 * PATCH * PATCH] = a * a, first[3 * PATCH * PATCH] = b * b, first[4 * PATCH * PATCH] = a * b;
        }
        float m[5];
        blur<5>(patch, between, m);
        const float s11 = m[2] - m[0] * m[0], s22 = m[3] - m[1] * m[1], s12 = m[4] - m[0] * m[1];
        const float c1 = 0.01f * 0.01f, c2 = 0.03f * 0.03f;
        const float a = 2.0f * m[0] * m[1] + c1, b = 2.0f * s12 + c2;
        const float per_d = 1.0f / (m[0] * m[0] + m[1] * m[1] + c1), per_e = 1.0f / (s11 + s22 + c2);
        const float value = a * b * per_d * per_e;
        const float g_square = -value * per_e, g_product = 2.0f * a * per_d * per_e;
        const float g_mean =
            2.0f * per_d * (m[1] * b * per_e - m[0] * value) - 2.0f * m[0] * g_square - m[1] * g_product;
        if (inside) {
            const float per_value = 1.0f / (3.0f * plane);
            similarity += value;
            planes[3 * c * plane + pixel] = g_mean * per_value;
            planes[(3 * c + 1) * plane + pixel] = g_square * per_value;
            planes[(3 * c + 2) * plane + pixel] = g_product * per_value;
        }
#endif
    }
    if (labels && inside && labels[pixel] >= 0) {
        labeled = 1.0f;
        of_labels = -logf((label_probability[pixel] + (float)FLOOR) / (1.0f + (float)FLOOR));
    }
    const float found[4] = {difference, similarity, of_labels, labeled};
    for (int i = 0; i < 4; i++) {
        const float sum = sum_in_block(found[i], scratch);
        if (THREAD == 0) sums[4 * BLOCK + i] = sum;
    }
}
