"""3D Gaussians and discs to screen splats and back on a GPU: splats.py, one thread a splat."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numba import cuda

from .cuda_kernel import cuda_kernel, device_function
from .settings import MAX_SH_COEFFICIENTS
from .splats import G_NORMAL, no_gradient, project_splat, project_splat_backward

SPLATS_A_BLOCK = 128
_COLUMNS = 16
_ABREAST = SPLATS_A_BLOCK // _COLUMNS
"""How many splats a block sums the gradient rows of at once, with one thread for each column."""


@functools.cache
def project_kernel(flat: bool) -> Any:
    """Kernel with a thread for each splat that fills its row of `splats` (N, 12) and, if `flat`, of `tilts` and
    `outlines`; arguments as of `cpu_project.project`."""

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
    """Sum of a column over the gradient rows of a splat, in their order."""
    total = 0.0
    for row in range(first, last):
        total += rows[row, column]
    return total


@functools.cache
def project_backward_kernel(flat: bool, columns: int) -> Any:
    """Kernel for blocks of SPLATS_A_BLOCK threads, one for each splat, that sums its gradient rows rows[firsts[n] :
    lasts[n], :columns] and carries them to its parameters; the other arguments as of `cpu_project.project_backward`."""
    with_normals = columns > G_NORMAL

    @cuda_kernel(launch_bounds=SPLATS_A_BLOCK)
    def project_backward(
        means, quats, scales, opacities, sh, view, splats, tilts, firsts, lasts, rows,
        g_means, g_quats, g_scales, g_opacities, g_sh, g_screen,
    ):  # fmt: skip
        sums = cuda.shared.array((SPLATS_A_BLOCK, columns), np.float64)
        thread = cuda.threadIdx.x
        begin = cuda.blockIdx.x * SPLATS_A_BLOCK
        # Neighbouring threads read neighbouring columns of a row.
        for member in range(thread // _COLUMNS, SPLATS_A_BLOCK, _ABREAST):
            n = begin + member
            if n < means.shape[0]:
                for column in range(thread % _COLUMNS, columns, _COLUMNS):
                    sums[member, column] = _total(rows, firsts[n], lasts[n], column)
        cuda.syncthreads()
        n = begin + thread
        if n >= means.shape[0]:
            return
        if firsts[n] == lasts[n]:
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
