// One step of Adam in place, for the rows used in a step, one warp per row; see adam.py.
//
// per_correction1, per_correction2: 1 / (1 - beta^t). bad () receives the number of rows whose gradient is not finite or
// too large, and which are not changed.
#include "platform.h"

KERNEL(ROWS_PER_BLOCK *WARP, 1) step_rows(
    float *values, float *exp_avg, float *exp_avg_sq, const long long *seen, const float *gradients, const bool *usable,
    const float *rates, float per_correction1, float per_correction2, int count, int columns, long long *bad) {
    SHARED(int, faulty, [ROWS_PER_BLOCK]);
    const int warp = THREAD / WARP, lane = THREAD % WARP, i = BLOCK * ROWS_PER_BLOCK + warp;
    const bool counted = i < count && (!usable || usable[i]);
    const float *g_row = gradients + (size_t)i * columns;
    if (lane == 0) faulty[warp] = 0;
    sync_warp();
    if (counted)
        for (int j = lane; j < columns; j += WARP)
            if (!(fabsf(g_row[j]) < (float)LARGEST_GRADIENT)) faulty[warp] = 1;
    sync_warp();
    if (!counted) return;
    if (faulty[warp]) {
        if (lane == 0) count_up(bad);
        return;
    }
    const size_t start = (size_t)seen[i] * columns;
    for (int j = lane; j < columns; j += WARP) {
        const float g = g_row[j];
        const float average = (float)BETA1 * exp_avg[start + j] + (1.0f - (float)BETA1) * g;
        const float square = (float)BETA2 * exp_avg_sq[start + j] + (1.0f - (float)BETA2) * g * g;
        exp_avg[start + j] = average;
        exp_avg_sq[start + j] = square;
        values[start + j] -= rates[j] * (average * per_correction1) / (sqrtf(square * per_correction2) + (float)EPSILON);
    }
}
