"""Anchors and heads -> Gaussians, differentiable (ObjectGS equations 2 and 3).

For offset j of an anchor at x with extents l, l': mean = x + o_j l, opacity = tanh, scale = l' sigmoid, rotation a
quaternion, colour SH coefficients. Splats that are too transparent to be drawn are not made.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import prange

from .. import device
from ..raster.kernel import kernel
from .anchors import Layout
from .heads import HIDDEN, Heads

OPACITY_MIN = 1.0 / 255.0
_RAW_OPACITY_MIN = np.float32(math.atanh(OPACITY_MIN))
LOG_EXTENT_MAX = 20.0
_CHUNK = 128


class Generated(NamedTuple):
    """Gaussians as `backend.raster.rasterize` takes them, and `source` (N,) int64: anchor * k + offset of each.

    made (N,) bool, on the GPU: where it is False there is none, only its place, with opacity 0. None: all are.
    """

    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    sh: torch.Tensor
    ids: torch.Tensor
    source: torch.Tensor
    made: torch.Tensor | None = None

    def select(self, which: torch.Tensor) -> Generated:
        """Those of a mask (N,), or of indices."""
        return self._each(lambda part: part[which])

    def cpu(self) -> Generated:
        """In the processor's memory."""
        return self._each(lambda part: part.cpu())

    def _each(self, change: Callable[[torch.Tensor], torch.Tensor]) -> Generated:
        return Generated(*(change(part) for part in self if part is not None))

    def only_made(self) -> Generated:
        """Without the places that hold none. Waits for the GPU to count them."""
        return self if self.made is None else self.select(self.made)._replace(made=None)


@kernel(parallel=True)
def _forward(positions, rows, opacity, shape, color, k, features, coefficients, starts, out):
    means, quats, scales, opacities, sh, source = out
    n_opacity = 3 * k + 6 + features
    n_shape = n_opacity + k
    n_color = n_shape + 7 * k
    count = positions.shape[0]
    for chunk in prange((count + _CHUNK - 1) // _CHUNK):
        extent = np.empty(6, np.float32)
        for a in range(chunk * _CHUNK, min(chunk * _CHUNK + _CHUNK, count)):
            at = starts[a]
            if at == starts[a + 1]:
                continue
            for i in range(6):
                extent[i] = math.exp(min(rows[a, 3 * k + i], np.float32(LOG_EXTENT_MAX)))
            for j in range(k):
                raw_opacity = opacity[a, j] + rows[a, n_opacity + j]
                if not raw_opacity > _RAW_OPACITY_MIN:
                    continue
                opacities[at] = math.tanh(raw_opacity)
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


@kernel(parallel=True)
def _count(rows, opacity, k, features, counts):
    n_opacity = 3 * k + 6 + features
    for a in prange(rows.shape[0]):
        kept = 0
        for j in range(k):
            if opacity[a, j] + rows[a, n_opacity + j] > _RAW_OPACITY_MIN:
                kept += 1
        counts[a] = kept


@kernel(parallel=True)
def _backward(rows, k, features, coefficients, starts, splats, grads, out):
    scales, opacities, source = splats
    g_means, g_quats, g_scales, g_opacities, g_sh = grads
    g_rows, g_opacity, g_shape, g_color = out
    n_opacity = 3 * k + 6 + features
    n_shape = n_opacity + k
    n_color = n_shape + 7 * k
    count = rows.shape[0]
    for chunk in prange((count + _CHUNK - 1) // _CHUNK):
        extent = np.empty(6, np.float32)
        for a in range(chunk * _CHUNK, min(chunk * _CHUNK + _CHUNK, count)):
            for i in range(g_rows.shape[1]):
                g_rows[a, i] = 0.0
            for i in range(k):
                g_opacity[a, i] = 0.0
            for i in range(7 * k):
                g_shape[a, i] = 0.0
            for i in range(g_color.shape[1]):
                g_color[a, i] = 0.0
            for i in range(6):
                extent[i] = math.exp(min(rows[a, 3 * k + i], np.float32(LOG_EXTENT_MAX)))
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


class _Generate(torch.autograd.Function):
    """Heads and assembly as one node: the heads' gradient is written by hand, so that nothing of an anchor's row is
    copied on the way and the features' gradient lands in the row's own columns."""

    @staticmethod
    def forward(ctx: Any, positions, rows, seen_from, layout: Layout, *parameters):
        w_hidden, b_hidden, w_opacity, b_opacity, w_shape, b_shape, w_color, b_color = parameters
        k, features = layout.offsets, layout.features
        inputs = rows[:, layout.feature_columns]
        inputs = inputs.contiguous() if seen_from is None else torch.cat([inputs, seen_from], 1)
        hidden = torch.addmm(b_hidden, inputs, w_hidden.T).relu_()
        h_opacity, h_shape, h_color = hidden.split(HIDDEN, 1)
        raw = (
            torch.addmm(b_opacity, h_opacity, w_opacity.T),
            torch.addmm(b_shape, h_shape, w_shape.T),
            torch.addmm(b_color, h_color, w_color.T),
        )
        opacity, shape, color = (r.numpy() for r in raw)
        values = rows.detach().numpy()
        coefficients = color.shape[1] // (3 * k)
        starts = np.zeros(len(values) + 1, np.int64)
        _count(values, opacity, k, features, starts[1:])
        np.cumsum(starts, out=starts)
        n = int(starts[-1])
        out = tuple(np.empty(s, np.float32) for s in ((n, 3), (n, 4), (n, 3), (n,), (n, coefficients, 3)))
        source = np.empty(n, np.int64)
        _forward(positions.numpy(), values, opacity, shape, color, k, features, coefficients, starts, (*out, source))
        ctx.arrays = (values, k, features, coefficients, starts, (out[2], out[3], source))
        ctx.layout = layout
        ctx.save_for_backward(inputs, hidden, w_hidden, w_opacity, w_shape, w_color)
        source_tensor = torch.from_numpy(source)
        ctx.mark_non_differentiable(source_tensor)
        return (*(torch.from_numpy(a) for a in out), source_tensor)

    @staticmethod
    def backward(ctx: Any, *gradients):
        inputs, hidden, w_hidden, w_opacity, w_shape, w_color = ctx.saved_tensors
        n = len(hidden)
        widths = (ctx.arrays[0].shape[1], len(w_opacity), len(w_shape), len(w_color))
        out = tuple(np.empty((n, width), np.float32) for width in widths)
        _backward(*ctx.arrays, tuple(np.ascontiguousarray(g.numpy()) for g in gradients[:5]), out)
        g_rows, *g_raw = (torch.from_numpy(a) for a in out)
        weights = (w_opacity, w_shape, w_color)
        g_hidden, of_parameters = _heads_backward(g_raw, inputs, hidden, weights)
        if not all(g.isfinite().all() for g in of_parameters):
            # The anchors at fault keep it to themselves; their own rows say so.
            faulty = ~torch.stack([g.isfinite().all(1) for g in g_raw]).all(0)
            sound = tuple(torch.where(faulty[:, None], 0.0, g) for g in g_raw)
            g_hidden, of_parameters = _heads_backward(sound, inputs, hidden, weights)
            g_hidden[faulty] = math.nan
        g_rows[:, ctx.layout.feature_columns] = (g_hidden @ w_hidden)[:, : ctx.layout.features]
        return (None, g_rows, None, None, *of_parameters)


def _heads_backward(
    g_raw: Sequence[torch.Tensor], inputs: torch.Tensor, hidden: torch.Tensor, weights: tuple[torch.Tensor, ...]
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """From the gradients of what the three heads say, each (n, width), to that of their hidden layer before its ReLU
    (n, 3 HIDDEN), and those of all weights and biases, the hidden layer's first."""
    g_hidden = torch.empty_like(hidden)
    of_heads = []
    for g, h, g_h, weight in zip(g_raw, hidden.split(HIDDEN, 1), g_hidden.split(HIDDEN, 1), weights, strict=True):
        g_h.copy_(g @ weight)
        of_heads += [g.T @ h, g.sum(0)]
    g_hidden = torch.ops.aten.threshold_backward(g_hidden, hidden, 0)
    return g_hidden, [g_hidden.T @ inputs, g_hidden.sum(0), *of_heads]


def _on_gpu(
    layout: Layout,
    positions: torch.Tensor,
    rows: torch.Tensor,
    ids: torch.Tensor,
    heads: Heads,
    seen_from: torch.Tensor | None,
    present: torch.Tensor | None,
) -> Generated:
    """The same equations in torch, with a place for every offset, so that nobody waits for a count."""
    n, k = len(rows), layout.offsets
    # One cut: its gradient is put together in one pass.
    offsets, extents, features, row_opacity, row_shape, row_color = rows.split(
        [3 * k, 6, layout.features, k, 7 * k, 3 * k], 1
    )
    raw_opacity, shape, color = heads(features if seen_from is None else torch.cat([features, seen_from], 1))
    raw_opacity = raw_opacity + row_opacity
    made = raw_opacity > float(_RAW_OPACITY_MIN)
    if present is not None:
        made = made & present[:, None]
    # The limit takes no gradient away: an extent beyond it must find back.
    extent = (extents + (extents.clamp(max=LOG_EXTENT_MAX) - extents).detach()).exp()
    raw_scale, quats = (shape + row_shape).view(n, k, 7).split([3, 4], 2)
    means = positions[:, None] + offsets.view(n, k, 3) * extent[:, None, :3]
    scales = extent[:, None, 3:] * raw_scale.sigmoid()
    sh = color.view(n, k, -1, 3)
    sh = torch.cat([sh[:, :, :1] + row_color.view(n, k, 1, 3), sh[:, :, 1:]], 2)
    return Generated(
        means.reshape(-1, 3), quats.reshape(-1, 4), scales.reshape(-1, 3),
        torch.where(made, raw_opacity.tanh(), 0.0).reshape(-1), sh.reshape(n * k, -1, 3),
        ids[:, None].expand(n, k).reshape(-1), torch.arange(n * k, device=rows.device), made.reshape(-1),
    )  # fmt: skip


def generate(
    layout: Layout,
    positions: torch.Tensor,
    rows: torch.Tensor,
    ids: torch.Tensor,
    heads: Heads,
    eye: np.ndarray | None = None,
    present: torch.Tensor | None = None,
) -> Generated:
    """Gaussians of n anchors: positions (n, 3), rows (n, columns), ids (n,) int32; differentiable in rows and heads.

    eye (3,): the camera's centre in scene units, needed in `view` mode alone. present (n,) bool, on the GPU alone: the
    other anchors make none.
    """
    seen_from = None
    if heads.mode == "view":
        if eye is None:
            raise ValueError("view mode needs the camera's centre")
        to_anchor = positions - device.upload(np.asarray(eye, np.float32), positions)
        distance = torch.linalg.vector_norm(to_anchor, dim=1, keepdim=True).clamp(min=1e-6)
        seen_from = torch.cat([distance, to_anchor / distance], 1)
    if device.on_gpu(rows):
        return _on_gpu(layout, positions, rows, ids, heads, seen_from, present)
    layers = (heads.hidden, heads.opacity, heads.shape, heads.color)
    parameters = [p for layer in layers for p in (layer.weight, layer.bias)]
    *tensors, source = _Generate.apply(positions, rows, seen_from, layout, *parameters)
    means, quats, scales, opacities, sh = tensors
    return Generated(means, quats, scales, opacities, sh, ids[source // layout.offsets], source)
