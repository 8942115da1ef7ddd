// Which rows may be updated after a view: those that were in view, if the loss is finite and anything was in view.
//
// in_view (): number of anchors in view; shown () receives the loss, NaN if nothing may be updated.
#include "platform.h"

KERNEL(128, 1) find_usable(
    const float *loss, const bool *present, const long long *in_view, int count, bool *usable, bool *finite,
    float *shown) {
    const int i = BLOCK * THREADS_OF_BLOCK + THREAD;
    if (i >= count) return;
    const bool sound = *loss - *loss == 0.0f && *in_view > 0;
    usable[i] = sound && present[i];
    if (i) return;
    *finite = sound;
    *shown = sound ? *loss : (float)(INFINITE - INFINITE);
}
