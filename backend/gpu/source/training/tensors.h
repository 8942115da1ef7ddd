// A table of tensors that an optimizer changes: for each, the addresses of its values, gradient, moments and number of
// steps, the number of its values, and the bits of its learning rate.
#ifndef TENSORS_H
#define TENSORS_H

#include "platform.h"

enum { VALUES, GRADIENT, AVERAGE, SQUARE, STEPS, SIZE, RATE, TABLE_COLUMNS };

DEVICE float *floats_at(const long long *table, int tensor, int column) {
    return (float *)table[tensor * TABLE_COLUMNS + column];
}
DEVICE int size_of(const long long *table, int tensor) { return (int)table[tensor * TABLE_COLUMNS + SIZE]; }

#endif
