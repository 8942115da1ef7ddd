"""Projection of 3D Gaussians and discs, and its gradient (splats.py), in parallel on the CPU."""

from __future__ import annotations

import numpy as np
from numba import prange

from ..kernel import kernel
from ..settings import MAX_SH_COEFFICIENTS
from ..splats import G_DEPTH, G_NORMAL, MSY, no_gradient, project_splat, project_splat_backward


@kernel(parallel=True)
def project(means, quats, scales, opacities, sh, view, width, height, splats, tilts, outlines):
    """Write the projected splats to `splats` (N, 12) float32; HALF_H < 0 marks splats that are not visible.

    means (N, 3), quats (N, 4) wxyz of any length, scales (N, 3), opacities (N,), sh (N, K, 3): float32. view: see
    `view_of`. tilts: None, or for discs (N, 12) float32 (discs.py); in this case outlines (N, 12) receives the ellipses
    around the discs, as splats, for tile intersection.
    """
    chunks = (means.shape[0] + 255) // 256
    for chunk in prange(chunks):
        R = np.empty((3, 3))
        T = np.empty((2, 3))
        V0 = np.empty(3)
        V1 = np.empty(3)
        basis = np.empty(MAX_SH_COEFFICIENTS)
        for n in range(chunk * 256, min(chunk * 256 + 256, means.shape[0])):
            project_splat(
                n, means, quats, scales, opacities, sh, view, width, height, splats, tilts, outlines,
                R, T, V0, V1, basis,
            )  # fmt: skip


@kernel(parallel=True)
def project_backward(
    means, quats, scales, opacities, sh, view, splats, tilts, row_offsets, rows,
    g_means, g_quats, g_scales, g_opacities, g_sh, g_screen,
):  # fmt: skip
    """Sum the gradient rows of each splat in order and propagate them to the Gaussian's parameters.

    row_offsets (N + 1,): splat n has rows[row_offsets[n] : row_offsets[n + 1]]. tilts: None for 3D Gaussians. g_* are
    written for all n (0 if not visible); g_screen (N, 2) receives dL/du and dL/dv in pixels for a translation of the
    whole footprint, which is the statistic for growth.
    """
    for chunk in prange((means.shape[0] + 255) // 256):
        _project_backward_chunk(
            np.int64(chunk), means, quats, scales, opacities, sh, view, splats, tilts, row_offsets, rows,
            g_means, g_quats, g_scales, g_opacities, g_sh, g_screen,
        )  # fmt: skip


@kernel()
def _project_backward_chunk(
    chunk, means, quats, scales, opacities, sh, view, splats, tilts, row_offsets, rows,
    g_means, g_quats, g_scales, g_opacities, g_sh, g_screen,
):  # fmt: skip
    with_normals = rows.shape[1] > G_NORMAL
    counted = G_DEPTH + 1
    if tilts is not None:
        counted = G_NORMAL + 3 if with_normals else MSY + 1
    R = np.empty((3, 3))
    T = np.empty((2, 3))
    basis = np.empty(MAX_SH_COEFFICIENTS)
    weights = np.empty(MAX_SH_COEFFICIENTS)
    g_color = np.empty(3)
    g = np.empty(counted)
    V0 = np.empty(3)
    V1 = np.empty(3)
    gR = np.empty((3, 3))
    gT = np.empty((2, 3))
    for n in range(chunk * 256, min(chunk * 256 + 256, means.shape[0])):
        if row_offsets[n] == row_offsets[n + 1]:
            no_gradient(n, g_means, g_quats, g_scales, g_opacities, g_sh, g_screen)
            continue
        for i in range(counted):
            g[i] = 0.0
        for row_id in range(row_offsets[n], row_offsets[n + 1]):
            for i in range(counted):
                g[i] += rows[row_id, i]
        project_splat_backward(
            n, g, with_normals, means, quats, scales, opacities, sh, view, splats, tilts,
            g_means, g_quats, g_scales, g_opacities, g_sh, g_screen, R, T, V0, V1, basis, gR, gT, weights, g_color,
        )  # fmt: skip
