// The anchors whose splats may overlap the image; see object_model.py.
//
// view: the upper three rows of the world-to-camera matrix; fx, fy, cx, cy; width, height, near plane. inside (count,)
// receives 1 or 0.
#include "platform.h"

KERNEL(128, 1) find_in_view(const float *positions, const float *rows, int count, int columns, const float *view, int *inside) {
    const int a = BLOCK * THREADS_OF_BLOCK + THREAD;
    if (a >= count) return;
    const float *row = rows + (size_t)a * columns, *position = positions + 3 * (size_t)a;
    const float fx = view[12], fy = view[13], cx = view[14], cy = view[15];
    const float width = view[16], height = view[17], near = view[18];
    float largest[3] = {0.0f, 0.0f, 0.0f}, extent[6], sound = 0.0f;
    for (int j = 0; j < OFFSETS; j++)
        for (int i = 0; i < 3; i++) {
            const float offset = fabsf(row[3 * j + i]);
            largest[i] = MAX(largest[i], offset);
            sound += offset - offset;  // NaN unless it is finite.
        }
    for (int i = 0; i < 6; i++) extent[i] = expf(MIN(row[3 * OFFSETS + i], (float)LOG_EXTENT_MAX));
    float square = 0.0f;
    for (int i = 0; i < 3; i++) square += largest[i] * extent[i] * (largest[i] * extent[i]);
    const float reach = sqrtf(square) + 3.4f * MAX(MAX(extent[3], extent[4]), extent[5]) + sound;
    float p[3];
    for (int i = 0; i < 3; i++)
        p[i] = view[4 * i] * position[0] + view[4 * i + 1] * position[1] + view[4 * i + 2] * position[2] + view[4 * i + 3];
    // The low-pass filter, or a disc's minimum footprint, adds up to 1.9 pixels at the border.
    const float room = -reach - 1.9f * MAX(p[2], near) / MIN(fx, fy);
    const float across[4] = {p[0], p[0], p[1], p[1]}, focal[4] = {fx, -fx, fy, -fy};
    const float to_edge[4] = {cx, width - cx, cy, height - cy};
    bool seen = p[2] + reach > near;
    for (int i = 0; i < 4; i++)
        seen = seen && (focal[i] * across[i] + to_edge[i] * p[2]) / sqrtf(focal[i] * focal[i] + to_edge[i] * to_edge[i]) > room;
    inside[a] = seen;
}
