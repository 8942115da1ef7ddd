// Sum of the volumes of splats, or the areas of discs (FLAT), and their number, for each block; see on_cpu.py.
#include "sums.h"

KERNEL(256, 1) volume(const float *scales, const bool *valid, int count, float *sums) {
    SHARED(float, scratch, [256]);
    const int n = BLOCK * THREADS_OF_BLOCK + THREAD;
    const size_t at = 3 * (size_t)n;
    const bool counted = n < count && (!valid || valid[n]);
    const float size = counted ? scales[at] * scales[at + 1] * (FLAT ? 1.0f : scales[at + 2]) : 0.0f;
    const float total = sum_in_block(size, scratch), number = sum_in_block(counted ? 1.0f : 0.0f, scratch);
    if (THREAD == 0) sums[2 * BLOCK] = total, sums[2 * BLOCK + 1] = number;
}
