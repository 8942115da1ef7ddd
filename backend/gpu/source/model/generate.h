// Columns of an anchor's row (anchors.py): offsets, extents, features, and residuals of opacity, shape and color.
#ifndef GENERATE_H
#define GENERATE_H

#include "platform.h"

#define AT_EXTENTS (3 * OFFSETS)
#define AT_OPACITY (3 * OFFSETS + 6 + FEATURES)
#define AT_SHAPE (AT_OPACITY + OFFSETS)
#define AT_COLOR (AT_SHAPE + 7 * OFFSETS)
#define ROW_COLUMNS (AT_COLOR + 3 * OFFSETS)

#endif
