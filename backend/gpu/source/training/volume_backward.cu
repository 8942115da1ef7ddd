// Gradient of the mean volume, times that of the loss, g ().
#include "platform.h"

KERNEL(128, 1) volume_backward(
    const float *scales, const bool *valid, const float *mean, const float *g, int count, float *g_scales) {
    const int n = BLOCK * THREADS_OF_BLOCK + THREAD;
    if (n >= count) return;
    const size_t at = 3 * (size_t)n;
    const float part = !valid || valid[n] ? *g / mean[1] : 0.0f;
    const float a = scales[at], b = scales[at + 1], c = FLAT ? 1.0f : scales[at + 2];
    g_scales[at] = part ? part * b * c : 0.0f;
    g_scales[at + 1] = part ? part * a * c : 0.0f;
    g_scales[at + 2] = part && !FLAT ? part * a * b : 0.0f;
}
