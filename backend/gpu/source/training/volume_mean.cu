// The mean volume, mean[0], and the number of splats, mean[1], from the sums of `blocks` blocks. One block.
#include "sums.h"

KERNEL(256, 1) volume_mean(const float *sums, int blocks, float *mean) {
    SHARED(double, scratch, [256]);
    const double total = sum_of_column(sums, blocks, 2, 0, scratch);
    const double splats = sum_of_column(sums, blocks, 2, 1, scratch), number = MAX(splats, 1.0);
    if (THREAD == 0) mean[0] = (float)(total / number), mean[1] = (float)number;
}
