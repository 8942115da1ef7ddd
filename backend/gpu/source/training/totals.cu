// Sums of the columns of an array (count, columns), times `scale`; one block for each column.
#include "sums.h"

KERNEL(256, 1) totals(const float *values, int count, int columns, float scale, float *sums) {
    SHARED(double, scratch, [256]);
    const double sum = sum_of_column(values, count, columns, BLOCK, scratch);
    if (THREAD == 0) sums[BLOCK] = (float)(sum * scale);
}
