"""Differentiable generation of Gaussians from anchors and heads (ObjectGS equations 2 and 3).

For offset j of an anchor at x with extents l, l': mean = x + o_j l, opacity = tanh(.), scale = l' sigmoid(.), rotation
as a quaternion, color as SH coefficients. The arguments are the output of the heads, the paper's MLP, plus residuals of
each offset, which the paper does not have; in paper mode, they are 0. Splats that are too transparent to be drawn are
not generated.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch

from ..gpu.kernel import WARP, kernel
from ..raster import devices
from .anchors import LOG_EXTENT_MAX, Layout
from .generate_on_cpu import RAW_OPACITY_MIN, Generate
from .heads import HIDDEN, Heads

_THREADS = 128
"""Number of threads per block of the gradient on a GPU, if an anchor has no more offsets."""


class Generated(NamedTuple):
    """Gaussians in the format of `backend.raster.rasterize`.

    Attributes:
        source: (N,) int64, anchor * k + offset of each Gaussian.
        valid: (N,) bool. On the GPU, every offset has an entry; False marks those without a Gaussian, whose opacity is
            0. None: all entries are Gaussians.
    """

    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    sh: torch.Tensor
    ids: torch.Tensor
    source: torch.Tensor
    valid: torch.Tensor | None = None

    def select(self, which: torch.Tensor) -> Generated:
        """Return the Gaussians selected by a mask (N,) or by indices."""
        return self._each(lambda part: part[which])

    def cpu(self) -> Generated:
        """Return the Gaussians in CPU memory."""
        return self._each(lambda part: part.cpu())

    def _each(self, change: Callable[[torch.Tensor], torch.Tensor]) -> Generated:
        return Generated(*(change(part) for part in self if part is not None))

    def only_valid(self) -> Generated:
        """Return the entries that are Gaussians; synchronizes with the GPU."""
        return self if self.valid is None else self.select(self.valid)._replace(valid=None)


class _GenerateOnGpu(torch.autograd.Function):
    """The equations with an entry for every offset, so that no synchronization is necessary."""

    @staticmethod
    def forward(
        ctx: Any,
        positions: torch.Tensor,
        rows: torch.Tensor,
        ids: torch.Tensor,
        seen_from: torch.Tensor | None,
        present: torch.Tensor | None,
        layout: Layout,
        *parameters: torch.Tensor,
    ) -> tuple[torch.Tensor, ...]:
        n, k = len(rows), layout.offsets
        features = rows[:, layout.feature_columns]
        inputs = features if seen_from is None else torch.cat([features, seen_from], 1)
        (w_hidden, b_hidden), *heads = zip(parameters[::2], parameters[1::2], strict=True)
        hidden = torch.addmm(b_hidden, inputs, w_hidden.T).relu_()
        units = hidden.split(HIDDEN, 1)
        outputs = [torch.addmm(b, x, w.T) for x, (w, b) in zip(units, heads, strict=True)]
        coefficients = len(parameters[-1]) // (3 * k)
        ctx.constants = {
            "OFFSETS": k, "FEATURES": layout.features, "COEFFICIENTS": coefficients, "LOG_EXTENT_MAX": LOG_EXTENT_MAX,
            "RAW_OPACITY_MIN": float(RAW_OPACITY_MIN),
        }  # fmt: skip
        count = n * k
        means, quats, scales = (rows.new_empty((count, width)) for width in (3, 4, 3))
        opacities, sh = rows.new_empty(count), rows.new_empty((count, coefficients, 3))
        of_splats, valid = ids.new_empty(count), torch.empty(count, dtype=torch.bool, device=rows.device)
        kernel("generate", **ctx.constants).for_each(
            count, positions, ids, rows, *outputs, present, count, means, quats, scales, opacities, sh, of_splats, valid
        )
        ctx.layout, ctx.parameters = layout, parameters
        # Autograd's outputs themselves would hold this node, and with it each other.
        ctx.save = rows, inputs, hidden, scales.detach(), opacities.detach(), valid
        ctx.mark_non_differentiable(of_splats, valid)
        ctx.set_materialize_grads(False)
        return means, quats, scales, opacities, sh, of_splats, valid

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        rows, inputs, hidden, scales, opacities, valid = ctx.save
        layout, k = ctx.layout, ctx.layout.offsets
        weights, biases = ctx.parameters[::2], ctx.parameters[1::2]
        of_splats = [None if g is None else g.contiguous() for g in gradients[:5]]
        g_rows = torch.empty_like(rows)
        g_outputs = [rows.new_empty((len(rows), len(bias))) for bias in biases[1:]]
        threads = max(_THREADS, WARP * math.ceil(k / WARP))
        kernel("generate_backward", THREADS_OF_GENERATE=threads, **ctx.constants)(
            math.ceil(len(rows) / (threads // k)), threads, rows, scales, opacities, valid,
            *of_splats, len(rows), g_rows, *g_outputs,
        )  # fmt: skip
        g_hidden = torch.empty_like(hidden)
        for g, weight, part in zip(g_outputs, weights[1:], g_hidden.split(HIDDEN, 1), strict=True):
            torch.mm(g, weight, out=part)
        g_hidden = torch.ops.aten.threshold_backward(g_hidden, hidden, 0.0)
        torch.mm(g_hidden, weights[0][:, : layout.features], out=g_rows[:, layout.feature_columns])
        pairs = zip((g_hidden, *g_outputs), (inputs, *hidden.split(HIDDEN, 1)), strict=True)
        of_parameters = itertools.chain.from_iterable((g.T @ x, g.sum(0)) for g, x in pairs)
        return (None, g_rows, None, None, None, None, *of_parameters)


def generate(
    layout: Layout,
    positions: torch.Tensor,
    rows: torch.Tensor,
    ids: torch.Tensor,
    heads: Heads,
    camera_center: np.ndarray | None = None,
    present: torch.Tensor | None = None,
) -> Generated:
    """Generate the Gaussians of n anchors (ObjectGS equations 2 and 3), differentiable in rows and heads.

    Args:
        layout: columns of the rows.
        positions: (n, 3) float32, in scene units.
        rows: (n, columns) float32.
        ids: (n,) int32 class index.
        heads: the heads of the model.
        camera_center: (3,), the camera's center in scene units; required only if the heads depend on the view.
        present: (n,) bool, only on the GPU: anchors for which it is False generate no Gaussians.
    """
    seen_from = None
    if heads.view_dependent:
        if camera_center is None:
            raise ValueError("a view-dependent model needs the camera's center")
        to_anchor = positions - devices.upload(np.asarray(camera_center, np.float32), positions)
        distance = torch.linalg.vector_norm(to_anchor, dim=1, keepdim=True).clamp(min=1e-6)
        seen_from = torch.cat([distance, to_anchor / distance], 1)
    layers = (heads.hidden, heads.opacity, heads.shape, heads.color)
    parameters = [p for layer in layers for p in (layer.weight, layer.bias)]
    if devices.on_gpu(rows):
        made = _GenerateOnGpu.apply(positions, rows, ids, seen_from, present, layout, *parameters)
        means, quats, scales, opacities, sh, of_splats, valid = made
        source = torch.arange(len(valid), device=rows.device)
        return Generated(means, quats, scales, opacities, sh, of_splats, source, valid)
    if seen_from is None:
        seen_from = positions.new_empty((len(positions), 0))
    *tensors, source = Generate.apply(positions, rows, seen_from, layout, *parameters)
    means, quats, scales, opacities, sh = tensors
    return Generated(means, quats, scales, opacities, sh, ids[source // layout.offsets], source)
