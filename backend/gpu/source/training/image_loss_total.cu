// The image loss, result[0], from the sums of `blocks` tiles, and the number of labeled pixels, result[1]. One block.
//
// more_labels (): a factor of the label loss, if it is given.
#include "sums.h"

KERNEL(256, 1) image_loss_total(
    const float *sums, int blocks, int values, float ssim_weight, float semantic_weight, const float *more_labels,
    float *result) {
    SHARED(double, scratch, [256]);
    double total[4];
    for (int i = 0; i < 4; i++) total[i] = sum_of_column(sums, blocks, 4, i, scratch);
    if (THREAD) return;
    const double labeled = MAX(total[3], 1.0), weight = semantic_weight * (more_labels ? *more_labels : 1.0f);
    double loss = (1.0 - ssim_weight) * total[0] / values + weight * total[2] / labeled;
    if (SSIM) loss += ssim_weight * (1.0 - total[1] / values);
    result[0] = (float)loss, result[1] = (float)labeled;
}
