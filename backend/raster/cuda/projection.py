"""Projection of 3D Gaussians and discs, and its gradient (splats.py), on a GPU with one thread per splat."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numba import cuda

from ..settings import MAX_SH_COEFFICIENTS
from ..splats import G_NORMAL, no_gradient, project_splat, project_splat_backward
from .kernel import cuda_kernel, device_function

SPLATS_PER_BLOCK = 128
_COLUMNS = 16
_ABREAST = SPLATS_PER_BLOCK // _COLUMNS
"""Number of splats whose gradient rows a block sums at a time, with one thread per column."""


@functools.cache
def project_kernel(flat: bool) -> Any:
    """Return a kernel with one thread per splat that writes its row of `splats` and, if `flat`, `tilts` and `outlines`.

    Arguments as in `backend.raster.cpu.projection.project`.
    """

    @cuda_kernel()
    def project(means, quats, scales, opacities, sh, view, width, height, splats, tilts, outlines):
        n = cuda.grid(1)
        if n >= means.shape[0]:
            return
        R = cuda.local.array((3, 3), np.float64)
        T = cuda.local.array((2, 3), np.float64)
        V0 = cuda.local.array(3, np.float64)
        V1 = cuda.local.array(3, np.float64)
        basis = cuda.local.array(MAX_SH_COEFFICIENTS, np.float64)
        if flat:
            project_splat(
                n, means, quats, scales, opacities, sh, view, width, height, splats, tilts, outlines,
                R, T, V0, V1, basis,
            )  # fmt: skip
        else:
            project_splat(
                n, means, quats, scales, opacities, sh, view, width, height, splats, None, splats, R, T, V0, V1, basis
            )

    return project


@device_function
def _total(rows, first, last, column):
    """Return the sum of a column over the gradient rows of a splat, in order."""
    total = 0.0
    for row in range(first, last):
        total += rows[row, column]
    return total


@functools.cache
def project_backward_kernel(flat: bool, columns: int) -> Any:
    """Return a kernel with one thread per splat that sums its gradient rows and propagates them to its parameters.

    The gradient rows are rows[first_rows[n] : last_rows[n], :columns]; other arguments as in
    `backend.raster.cpu.projection.project_backward`.
    """
    with_normals = columns > G_NORMAL

    @cuda_kernel(launch_bounds=SPLATS_PER_BLOCK)
    def project_backward(
        means, quats, scales, opacities, sh, view, splats, tilts, first_rows, last_rows, rows,
        g_means, g_quats, g_scales, g_opacities, g_sh, g_screen,
    ):  # fmt: skip
        sums = cuda.shared.array((SPLATS_PER_BLOCK, columns), np.float64)
        thread = cuda.threadIdx.x
        begin = cuda.blockIdx.x * SPLATS_PER_BLOCK
        # Neighboring threads read neighboring columns of a row.
        for member in range(thread // _COLUMNS, SPLATS_PER_BLOCK, _ABREAST):
            n = begin + member
            if n < means.shape[0]:
                for column in range(thread % _COLUMNS, columns, _COLUMNS):
                    sums[member, column] = _total(rows, first_rows[n], last_rows[n], column)
        cuda.syncthreads()
        n = begin + thread
        if n >= means.shape[0]:
            return
        if first_rows[n] == last_rows[n]:
            no_gradient(n, g_means, g_quats, g_scales, g_opacities, g_sh, g_screen)
            return
        g = cuda.local.array(columns, np.float64)
        for column in range(columns):
            g[column] = sums[thread, column]
        R = cuda.local.array((3, 3), np.float64)
        T = cuda.local.array((2, 3), np.float64)
        V0 = cuda.local.array(3, np.float64)
        V1 = cuda.local.array(3, np.float64)
        gR = cuda.local.array((3, 3), np.float64)
        gT = cuda.local.array((2, 3), np.float64)
        basis = cuda.local.array(MAX_SH_COEFFICIENTS, np.float64)
        weights = cuda.local.array(MAX_SH_COEFFICIENTS, np.float64)
        g_color = cuda.local.array(3, np.float64)
        if flat:
            project_splat_backward(
                n, g, with_normals, means, quats, scales, opacities, sh, view, splats, tilts,
                g_means, g_quats, g_scales, g_opacities, g_sh, g_screen, R, T, V0, V1, basis, gR, gT, weights, g_color,
            )  # fmt: skip
        else:
            project_splat_backward(
                n, g, with_normals, means, quats, scales, opacities, sh, view, splats, None,
                g_means, g_quats, g_scales, g_opacities, g_sh, g_screen, R, T, V0, V1, basis, gR, gT, weights, g_color,
            )  # fmt: skip

    return project_backward
