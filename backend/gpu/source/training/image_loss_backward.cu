// Gradient of the image loss, times that of its result, g (); and the sums over each tile of the background's gradient.
#include "image_loss.h"

KERNEL(THREADS, 1) image_loss_backward(
    const float *color, const float *alpha, const float *label_probability, const float *background,
    const float *target, const int *labels, const float *planes, const float *result, const float *g, int width,
    int height, float ssim_weight, float semantic_weight, const float *more_labels, float *g_color, float *g_alpha,
    float *g_label_probability, float *sums) {
    SHARED(float, scratch, [THREADS]);
    const int across = (width + TILE - 1) / TILE;
    const int left = BLOCK % across * TILE, top = BLOCK / across * TILE;
    const int x = left + THREAD % TILE, y = top + THREAD / TILE;
    const bool inside = x < width && y < height;
    const size_t plane = (size_t)width * height, pixel = (size_t)y * width + x;
    const float step = (1.0f - ssim_weight) / (3.0f * plane);
    float of_alpha = 0.0f;
    for (int c = 0; c < 3; c++) {
        float gradient = 0.0f;
        const float a = inside ? shown(color, alpha, background, c, plane, pixel) : 0.0f;
        const float b = inside ? target[c * plane + pixel] : 0.0f;
#if SSIM
        SHARED(float, patch, [3][PATCH][PATCH]);
        SHARED(float, between, [3][PATCH][TILE]);
        sync_block();
        for (int i = THREAD; i < PATCH * PATCH; i += THREADS) {
            const int u = left + i % PATCH - MARGIN, v = top + i / PATCH - MARGIN;
            const bool there = u >= 0 && u < width && v >= 0 && v < height;
            for (int p = 0; p < 3; p++)
                patch[p][i / PATCH][i % PATCH] = there ? planes[(3 * c + p) * plane + (size_t)v * width + u] : 0.0f;
        }
        float back[3];
        blur<3>(patch, between, back);
        gradient = -ssim_weight * (back[0] + 2.0f * a * back[1] + b * back[2]);
#endif
        gradient = *g * (gradient + step * sign_of(a - b));
        if (inside) {
            g_color[c * plane + pixel] = gradient;
            of_alpha -= gradient * background[c];
        }
        const float sum = sum_in_block(inside ? gradient * (1.0f - alpha[pixel]) : 0.0f, scratch);
        if (THREAD == 0) sums[3 * BLOCK + c] = sum;
    }
    if (!inside) return;
    g_alpha[pixel] = of_alpha;
    if (!labels) return;
    const float weight = *g * semantic_weight * (more_labels ? *more_labels : 1.0f);
    g_label_probability[pixel] =
        labels[pixel] >= 0 ? -weight / (result[1] * (label_probability[pixel] + (float)FLOOR)) : 0.0f;
}
