// Decides whether the tensors of a table may be updated: whether all gradients are smaller than LARGEST_GRADIENT, and
// `finite` () holds, if it is given. If so, their numbers of steps grow by 1. One block.
#include "tensors.h"

KERNEL(1024, 1) check_tensors(const long long *table, int tensors, const bool *finite, bool *usable) {
    bool faulty = false;
    for (int t = 0; t < tensors; t++) {
        const float *gradient = floats_at(table, t, GRADIENT);
        for (int i = THREAD; i < size_of(table, t); i += THREADS_OF_BLOCK)
            if (!(fabsf(gradient[i]) < (float)LARGEST_GRADIENT)) faulty = true;
    }
    const bool skipped = any_in_block(faulty || (finite && !*finite));
    if (THREAD == 0) *usable = !skipped;
    if (!skipped && THREAD < tensors) *floats_at(table, THREAD, STEPS) += 1.0f;
}
