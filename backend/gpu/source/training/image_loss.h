// Parts of the image loss: a tile of 16x16 pixels with the margin that the window of SSIM needs.
#ifndef IMAGE_LOSS_H
#define IMAGE_LOSS_H

#include "sums.h"

#define TILE 16
#define THREADS (TILE * TILE)
#define TAPS 11
#define MARGIN (TAPS / 2)
#define PATCH (TILE + 2 * MARGIN)

// Returns a channel of the picture: the rendered color on the background.
DEVICE float shown(const float *color, const float *alpha, const float *background, int c, size_t plane, size_t pixel) {
    return color[c * plane + pixel] + (1.0f - alpha[pixel]) * background[c];
}

DEVICE float sign_of(float x) { return x > 0.0f ? 1.0f : x < 0.0f ? -1.0f : x; }

// Blurs `count` planes of a patch along its rows, then along the columns at this thread's pixel. between: planes of
// PATCH rows and TILE columns, in shared memory.
template <int count>
DEVICE void blur(const float (*patch)[PATCH][PATCH], float (*between)[PATCH][TILE], float *out) {
    const float taps[TAPS] = WINDOW;
    sync_block();
    for (int i = THREAD; i < PATCH * TILE; i += THREADS) {
        const int y = i / TILE, x = i % TILE;
        for (int p = 0; p < count; p++) {
            float sum = 0.0f;
            for (int t = 0; t < TAPS; t++) sum += taps[t] * patch[p][y][x + t];
            between[p][y][x] = sum;
        }
    }
    sync_block();
    for (int p = 0; p < count; p++) {
        float sum = 0.0f;
        for (int t = 0; t < TAPS; t++) sum += taps[t] * between[p][THREAD / TILE + t][THREAD % TILE];
        out[p] = sum;
    }
}

#endif
