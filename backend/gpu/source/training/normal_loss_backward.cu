// Gradient of the normal loss, times that of its result, g ().
#include "platform.h"

KERNEL(128, 1) normal_loss_backward(
    const float *depth, const float *alpha, const float *partial, const float *g, float fx, float fy, float cx, float cy,
    int width, int height, float *g_normals, float *g_depth, float *g_alpha) {
    const int n = BLOCK * THREADS_OF_BLOCK + THREAD, x = n % width, y = n / width, plane = width * height;
    if (n >= plane) return;
    const float ray[3] = {(x + 0.5f - cx) / fx, (y + 0.5f - cy) / fy, 1.0f}, scale = *g / (float)plane;
    float of_depth = 0.0f;
    bool covered = false;
    for (int i = 0; i < 3; i++) {
        const float *across = partial + (size_t)i * plane, *down = partial + (size_t)(3 + i) * plane;
        const float normal = partial[(size_t)(6 + i) * plane + n];
        float g_point = 0.0f;
        if (x > 0) g_point += across[n - 1];
        if (x < width - 1) g_point -= across[n + 1];
        if (y > 0) g_point += down[n - width];
        if (y < height - 1) g_point -= down[n + width];
        of_depth += g_point * ray[i];
        covered = covered || normal != 0.0f;
        g_normals[(size_t)i * plane + n] = -scale * normal;
    }
    const bool drawn = alpha[n] > 0.0f && of_depth != 0.0f;
    g_depth[n] = drawn ? scale * of_depth / alpha[n] : 0.0f;
    g_alpha[n] = scale * ((covered ? 1.0f : 0.0f) - (drawn ? of_depth * depth[n] / (alpha[n] * alpha[n]) : 0.0f));
}
