"""Comparison of points with the surface that a photo shows."""

from __future__ import annotations

from ..raster.kernel import kernel


@kernel()
def compare(xyz, projection, first, stride, rows, columns, depths, planes, pixels, in_front, agrees, result):
    """Write, for points (n, 3), 1 where a photo shows a surface there, -1 where it shows one behind, else 0.

    Args:
        xyz: (n, 3) float64.
        projection: (3, 4) float64, from the world to columns and rows, times the depth, and the depth.
        first, stride, rows, columns: the grid's first column and row, its spacing and its shape.
        depths, planes, pixels: as in `depth_maps.DepthMap`.
        in_front, agrees: relative differences in depth from which on a point is in front, and up to which it agrees.
        result: (n,) int64.
    """
    for n in range(len(xyz)):
        result[n] = 0
        x, y, z = xyz[n, 0], xyz[n, 1], xyz[n, 2]
        depth = projection[2, 0] * x + projection[2, 1] * y + projection[2, 2] * z + projection[2, 3]
        if not depth > 0:
            continue
        u = (projection[0, 0] * x + projection[0, 1] * y + projection[0, 2] * z + projection[0, 3]) / depth - 0.5
        v = (projection[1, 0] * x + projection[1, 1] * y + projection[1, 2] * z + projection[1, 3]) / depth - 0.5
        column, row = round((u - first) / stride), round((v - first) / stride)
        if not (0 <= column < columns and 0 <= row < rows):
            continue
        i = int(row) * columns + int(column)
        if not depths[i] > 0:
            continue
        # The inverse depth of the surface in the point's pixel, relative to that of the point.
        nearness = (planes[i, 0] + planes[i, 1] * (u - pixels[i, 0]) + planes[i, 2] * (v - pixels[i, 1])) * depth
        if nearness < 1 / (1 + in_front):
            result[n] = -1
        elif abs(nearness - 1) < agrees:
            result[n] = 1
