// The target of a view: its image (3, H, W) from bytes, times the scale of each channel; and its labels (H, W).
#include "platform.h"

KERNEL(128, 1) load_target(
    const unsigned char *pixels, const LABEL *stored, float red, float green, float blue, int count, float *image,
    int *labels) {
    const int n = BLOCK * THREADS_OF_BLOCK + THREAD;
    if (n >= count) return;
    const size_t plane = count;
    image[n] = pixels[n] * red;
    image[plane + n] = pixels[plane + n] * green;
    image[2 * plane + n] = pixels[2 * plane + n] * blue;
    if (stored) labels[n] = stored[n];
}
