// Sorts runs of splats with equal keys by position, shape, opacity, color and ID, so that images do not depend on the
// order of the input. Each run is sorted by the thread of its first element, by heap sort, as thousands may be equal.
#include "binning.h"

DEVICE bool before(const float *splats, const int *ids, long long i, long long j) {
    for (int column = 0; column < DEPTH; column++) {
        float a = splats[i * SPLAT_COLUMNS + column], b = splats[j * SPLAT_COLUMNS + column];
        if (a != b) return a < b;
    }
    if (ids[i] != ids[j]) return ids[i] < ids[j];
    return i < j;
}

DEVICE void swap(long long *a, long long *b) {
    long long kept = *a;
    *a = *b, *b = kept;
}

DEVICE void sift(const float *splats, const int *ids, long long *run, int root, int end) {
    while (2 * root + 1 < end) {
        int child = 2 * root + 1;
        if (child + 1 < end && before(splats, ids, run[child], run[child + 1])) child++;
        if (!before(splats, ids, run[root], run[child])) return;
        swap(run + root, run + child);
        root = child;
    }
}

KERNEL(128, 1) order_equals(const float *splats, const int *ids, const long long *keys, int count, long long *order) {
    const int first = BLOCK * THREADS_OF_BLOCK + THREAD;
    if (first + 1 >= count) return;
    const long long key = keys[first];
    if (key != keys[first + 1] || key == UNSEEN || (first > 0 && keys[first - 1] == key)) return;
    int last = first + 2;
    while (last < count && keys[last] == key) last++;
    const int length = last - first;
    for (int start = length / 2 - 1; start >= 0; start--) sift(splats, ids, order + first, start, length);
    for (int end = length - 1; end > 0; end--) {
        swap(order + first, order + first + end);
        sift(splats, ids, order + first, 0, end);
    }
}
