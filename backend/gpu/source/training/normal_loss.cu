// Sums of alpha - normals . N over the pixels of each block for which the depth has a normal N; see on_cpu.py.
//
// N is perpendicular to the difference of the left and right neighbors' points, and to that of the upper and lower ones.
// partial (9, H, W) receives the sum's gradient with respect to the two differences, then N; 0 where there is none.
#include "sums.h"

KERNEL(256, 1) normal_loss(
    const float *normals, const float *depth, const float *alpha, float fx, float fy, float cx, float cy, int width,
    int height, float *partial, float *sums) {
    SHARED(float, scratch, [256]);
    const int n = BLOCK * THREADS_OF_BLOCK + THREAD, x = n % width, y = n / width, plane = width * height;
    float term = 0.0f;
    if (n < plane) {
        float found[9] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
        const bool border = x == 0 || y == 0 || x == width - 1 || y == height - 1;
        if (!border && alpha[n] > (float)SOLID && alpha[n - 1] > (float)SOLID && alpha[n + 1] > (float)SOLID &&
            alpha[n - width] > (float)SOLID && alpha[n + width] > (float)SOLID) {
            const float rx = (x + 0.5f - cx) / fx, ry = (y + 0.5f - cy) / fy;
            const float left = depth[n - 1] / alpha[n - 1], right = depth[n + 1] / alpha[n + 1];
            const float above = depth[n - width] / alpha[n - width], below = depth[n + width] / alpha[n + width];
            const float az = right - left, bz = below - above;
            const float ax = rx * az + (right + left) / fx, ay = ry * az;
            const float bx = rx * bz, by = ry * bz + (below + above) / fy;
            float nx = by * az - ay * bz, ny = ax * bz - bx * az, nz = ay * bx - ax * by;
            const float length = sqrtf(nx * nx + ny * ny + nz * nz);
            nx /= length, ny /= length, nz /= length;
            // False for NaN.
            if (-(nx * rx + ny * ry + nz) > (float)GRAZING * sqrtf(rx * rx + ry * ry + 1.0f)) {
                const float mx = normals[n], my = normals[plane + n], mz = normals[2 * plane + n];
                const float along = mx * nx + my * ny + mz * nz;
                term = alpha[n] - along;
                // N = -(a x b) / |a x b|
                const float gx = (mx - along * nx) / length, gy = (my - along * ny) / length;
                const float gz = (mz - along * nz) / length;
                found[0] = by * gz - bz * gy, found[1] = bz * gx - bx * gz, found[2] = bx * gy - by * gx;
                found[3] = gy * az - gz * ay, found[4] = gz * ax - gx * az, found[5] = gx * ay - gy * ax;
                found[6] = nx, found[7] = ny, found[8] = nz;
            }
        }
        for (int i = 0; i < 9; i++) partial[(size_t)i * plane + n] = found[i];
    }
    const float sum = sum_in_block(term, scratch);
    if (THREAD == 0) sums[BLOCK] = sum;
}
