// Sums over a block in a fixed order.
#ifndef SUMS_H
#define SUMS_H

#include "platform.h"

// Returns the sum of `value` over the THREADS_OF_BLOCK threads, a power of 2, to all of them; scratch: one element for
// each thread, in shared memory.
template <typename T>
DEVICE T sum_in_block(T value, T *scratch) {
    sync_block();
    scratch[THREAD] = value;
    for (int half = THREADS_OF_BLOCK / 2; half > 0; half /= 2) {
        sync_block();
        if (THREAD < half) scratch[THREAD] += scratch[THREAD + half];
    }
    sync_block();
    return scratch[0];
}

// Returns the sum of a column of an array (count, columns) to all threads of a block.
DEVICE double sum_of_column(const float *values, int count, int columns, int column, double *scratch) {
    double sum = 0.0;
    for (int i = THREAD; i < count; i += THREADS_OF_BLOCK) sum += values[(size_t)i * columns + column];
    return sum_in_block(sum, scratch);
}

#endif
