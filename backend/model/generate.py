"""Anchors and heads -> Gaussians, differentiable (ObjectGS equations 2 and 3).

For offset j of an anchor at x with extents l, l': mean = x + o_j l, opacity = tanh, scale = l' sigmoid, rotation a
quaternion, colour SH coefficients. Splats that are too transparent to be drawn are not made.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit, prange

from .anchors import Layout

OPACITY_MIN = 1.0 / 255.0
_LOG_EXTENT_MAX = 20.0


class Generated(NamedTuple):
    """Gaussians as `backend.raster.rasterize` takes them, and `source` (N,) int64: anchor * k + offset of each."""

    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    sh: torch.Tensor
    ids: torch.Tensor
    source: torch.Tensor


@njit(cache=True, error_model="numpy", parallel=True)
def _forward(positions, rows, opacity, shape, color, k, features, coefficients, starts, out):
    means, quats, scales, opacities, sh, source = out
    n_opacity = 3 * k + 6 + features
    n_shape = n_opacity + k
    n_color = n_shape + 7 * k
    for a in prange(positions.shape[0]):
        at = starts[a]
        if at == starts[a + 1]:
            continue
        extent = np.empty(6, np.float32)
        for i in range(6):
            extent[i] = math.exp(min(rows[a, 3 * k + i], np.float32(_LOG_EXTENT_MAX)))
        for j in range(k):
            alpha = math.tanh(opacity[a, j] + rows[a, n_opacity + j])
            if not alpha > OPACITY_MIN:
                continue
            opacities[at] = alpha
            source[at] = a * k + j
            for i in range(3):
                means[at, i] = positions[a, i] + rows[a, 3 * j + i] * extent[i]
                raw = shape[a, 7 * j + i] + rows[a, n_shape + 7 * j + i]
                scales[at, i] = extent[3 + i] / (np.float32(1.0) + math.exp(-raw))
            for i in range(4):
                quats[at, i] = shape[a, 7 * j + 3 + i] + rows[a, n_shape + 7 * j + 3 + i]
            for c in range(coefficients):
                for i in range(3):
                    sh[at, c, i] = color[a, (j * coefficients + c) * 3 + i]
            for i in range(3):
                sh[at, 0, i] += rows[a, n_color + 3 * j + i]
            at += 1


@njit(cache=True, error_model="numpy", parallel=True)
def _count(rows, opacity, k, features, counts):
    n_opacity = 3 * k + 6 + features
    for a in prange(rows.shape[0]):
        kept = 0
        for j in range(k):
            if math.tanh(opacity[a, j] + rows[a, n_opacity + j]) > OPACITY_MIN:
                kept += 1
        counts[a] = kept


@njit(cache=True, error_model="numpy", parallel=True)
def _backward(rows, k, features, coefficients, starts, splats, grads, out):
    scales, opacities, source = splats
    g_means, g_quats, g_scales, g_opacities, g_sh = grads
    g_rows, g_opacity, g_shape, g_color = out
    n_opacity = 3 * k + 6 + features
    n_shape = n_opacity + k
    n_color = n_shape + 7 * k
    for a in prange(rows.shape[0]):
        for i in range(g_rows.shape[1]):
            g_rows[a, i] = 0.0
        for i in range(k):
            g_opacity[a, i] = 0.0
        for i in range(7 * k):
            g_shape[a, i] = 0.0
        for i in range(g_color.shape[1]):
            g_color[a, i] = 0.0
        extent = np.empty(6, np.float32)
        for i in range(6):
            extent[i] = math.exp(min(rows[a, 3 * k + i], np.float32(_LOG_EXTENT_MAX)))
        for n in range(starts[a], starts[a + 1]):
            j = source[n] - a * k
            alpha = opacities[n]
            g = g_opacities[n] * (np.float32(1.0) - alpha * alpha)
            g_opacity[a, j] = g
            g_rows[a, n_opacity + j] = g
            for i in range(3):
                g_rows[a, 3 * j + i] = g_means[n, i] * extent[i]
                g_rows[a, 3 * k + i] += g_means[n, i] * rows[a, 3 * j + i] * extent[i]
                g_rows[a, 3 * k + 3 + i] += g_scales[n, i] * scales[n, i]
                share = scales[n, i] / extent[3 + i]
                g = g_scales[n, i] * scales[n, i] * (np.float32(1.0) - share)
                g_shape[a, 7 * j + i] = g
                g_rows[a, n_shape + 7 * j + i] = g
                g_rows[a, n_color + 3 * j + i] = g_sh[n, 0, i]
            for i in range(4):
                g_shape[a, 7 * j + 3 + i] = g_quats[n, i]
                g_rows[a, n_shape + 7 * j + 3 + i] = g_quats[n, i]
            for c in range(coefficients):
                for i in range(3):
                    g_color[a, (j * coefficients + c) * 3 + i] = g_sh[n, c, i]


class _Assemble(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, positions, rows, opacity, shape, color, layout: Layout):
        arrays = [t.detach().numpy() for t in (positions, rows, opacity, shape, color)]
        k, features = layout.offsets, layout.features
        coefficients = arrays[4].shape[1] // (3 * k)
        starts = np.zeros(len(arrays[0]) + 1, np.int64)
        _count(arrays[1], arrays[2], k, features, starts[1:])
        np.cumsum(starts, out=starts)
        n = int(starts[-1])
        out = tuple(np.empty(s, np.float32) for s in ((n, 3), (n, 4), (n, 3), (n,), (n, coefficients, 3)))
        source = np.empty(n, np.int64)
        _forward(*arrays, k, features, coefficients, starts, (*out, source))
        ctx.saved = (arrays[1], k, features, coefficients, starts, (out[2], out[3], source))
        ctx.widths = [a.shape[1] for a in arrays[1:]]
        tensors = [torch.from_numpy(a) for a in out]
        source_tensor = torch.from_numpy(source)
        ctx.mark_non_differentiable(source_tensor)
        return (*tensors, source_tensor)

    @staticmethod
    def backward(ctx: Any, *gradients):
        rows = ctx.saved[0]
        out = tuple(np.empty((len(rows), width), np.float32) for width in ctx.widths)
        grads = tuple(np.ascontiguousarray(g.numpy()) for g in gradients[:5])
        _backward(*ctx.saved, grads, out)
        return (None, *(torch.from_numpy(a) for a in out), None)


def generate(
    layout: Layout,
    positions: torch.Tensor,
    rows: torch.Tensor,
    ids: torch.Tensor,
    heads: torch.nn.Module,
    eye: np.ndarray | None = None,
) -> Generated:
    """Gaussians of n anchors: positions (n, 3), rows (n, columns), ids (n,) int32; differentiable in rows and heads.

    eye (3,): the camera's centre in scene units, needed in `view` mode alone.
    """
    features = rows[:, layout.feature_columns]
    if heads.mode == "view":
        if eye is None:
            raise ValueError("view mode needs the camera's centre")
        to_anchor = positions - torch.as_tensor(eye, dtype=positions.dtype)
        distance = torch.linalg.vector_norm(to_anchor, dim=1, keepdim=True).clamp(min=1e-6)
        features = torch.cat([features, distance, to_anchor / distance], 1)
    opacity, shape, color = heads(features)
    *tensors, source = _Assemble.apply(positions, rows, opacity, shape, color, layout)
    means, quats, scales, opacities, sh = tensors
    return Generated(means, quats, scales, opacities, sh, ids[source // layout.offsets], source)
