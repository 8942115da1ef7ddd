// Sort keys of splats: depth, then column. Depths are positive, so their bits have the same order as the numbers.
#include "binning.h"

KERNEL(128, 1) write_keys(const float *splats, int count, long long *keys) {
    const int n = BLOCK * THREADS_OF_BLOCK + THREAD;
    if (n >= count) return;
    const float *splat = splats + (size_t)n * SPLAT_COLUMNS;
    if (!(splat[HALF_H] > 0.0f)) {
        keys[n] = UNSEEN;
        return;
    }
    long long across = 0;
    if (splat[U] != 0.0f) {
        across = bits_of(splat[U]);
        if (across < 0) across = -(across & 0x7fffffffLL);
    }
    keys[n] = bits_of(splat[DEPTH]) * 0x100000000LL + across + 0x80000000LL;
}
