// Sums of growth statistics over a view, one thread per anchor, each of which occurs once; see growth.py.
#include "platform.h"

KERNEL(128, 1) add_statistics(
    const long long *anchors_seen, const bool *usable, const float *opacities, const bool *drawn,
    const float *screen_gradient, float half_width, float half_height, int count, int offsets, float *gradient,
    int *visits, float *opacity, int *views) {
    const int i = BLOCK * THREADS_OF_BLOCK + THREAD;
    if (i >= count || (usable && !usable[i])) return;
    const long long anchor = anchors_seen[i];
    float total = 0.0f;
    for (int j = 0; j < offsets; j++) {
        const size_t n = (size_t)i * offsets + j, to = (size_t)anchor * offsets + j;
        total += opacities[n];
        if (!drawn[n]) continue;
        const float x = screen_gradient[2 * n] * half_width, y = screen_gradient[2 * n + 1] * half_height;
        const float norm = sqrtf(x * x + y * y);
        if (!(norm - norm == 0.0f)) continue;  // It is not finite.
        gradient[to] += norm;
        visits[to]++;
    }
    opacity[anchor] += total;
    views[anchor]++;
}
