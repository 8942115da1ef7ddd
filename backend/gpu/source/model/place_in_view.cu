// The anchors in view, followed by the others, as far as `limit` allows. before: the number of anchors in view up to and
// including each one.
#include "platform.h"

KERNEL(128, 1) place_in_view(
    const int *inside, const long long *before, int count, int limit, long long *index, bool *in_view) {
    const int a = BLOCK * THREADS_OF_BLOCK + THREAD;
    if (a >= count) return;
    const long long seen = before[count - 1];
    const long long place = inside[a] ? before[a] - 1 : seen + a - before[a];
    if (place < limit) index[place] = a;
    if (a < limit) in_view[a] = a < seen;
}
