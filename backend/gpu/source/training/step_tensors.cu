// One step of Adam for the tensors of a table, in place, if `usable` () holds; BLOCKS_PER_TENSOR blocks for each tensor.
#include "tensors.h"

KERNEL(256, 1) step_tensors(const long long *table, const bool *usable) {
    SHARED(float, corrections, [2]);
    if (!*usable) return;
    const int t = BLOCK / BLOCKS_PER_TENSOR, part = BLOCK % BLOCKS_PER_TENSOR;
    if (THREAD == 0) {
        const double steps = *floats_at(table, t, STEPS);
        corrections[0] = (float)(1.0 / (1.0 - pow(BETA1, steps)));
        corrections[1] = (float)(1.0 / (1.0 - pow(BETA2, steps)));
    }
    sync_block();
    float *values = floats_at(table, t, VALUES), *averages = floats_at(table, t, AVERAGE);
    float *squares = floats_at(table, t, SQUARE);
    const float *gradient = floats_at(table, t, GRADIENT);
    const float rate = *(const float *)(table + t * TABLE_COLUMNS + RATE);
    for (int i = part * THREADS_OF_BLOCK + THREAD; i < size_of(table, t); i += BLOCKS_PER_TENSOR * THREADS_OF_BLOCK) {
        const float g = gradient[i];
        const float average = (float)BETA1 * averages[i] + (1.0f - (float)BETA1) * g;
        const float square = (float)BETA2 * squares[i] + (1.0f - (float)BETA2) * g * g;
        averages[i] = average;
        squares[i] = square;
        values[i] -= rate * (average * corrections[0]) / (sqrtf(square * corrections[1]) + (float)EPSILON);
    }
}
