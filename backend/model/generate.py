"""Differentiable generation of Gaussians from anchors and heads (ObjectGS equations 2 and 3).

For offset j of an anchor at x with extents l, l': mean = x + o_j l, opacity = tanh(.), scale = l' sigmoid(.), rotation
as a quaternion, color as SH coefficients. The arguments are the output of the heads, the paper's MLP, plus residuals of
each offset, which the paper does not have; in paper mode, they are 0. Splats that are too transparent to be drawn are
not generated.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from ..raster import devices
from .anchors import LOG_EXTENT_MAX, Layout
from .generate_on_cpu import RAW_OPACITY_MIN, Generate
from .heads import Heads


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


def _on_gpu(
    layout: Layout,
    positions: torch.Tensor,
    rows: torch.Tensor,
    ids: torch.Tensor,
    heads: Heads,
    seen_from: torch.Tensor | None,
    present: torch.Tensor | None,
) -> Generated:
    """Evaluate the equations in torch, with an entry for every offset, so that no synchronization is necessary."""
    n, k = len(rows), layout.offsets
    # A single split, so that the gradient is assembled in one pass.
    offsets, extents, features, row_opacity, row_shape, row_color = rows.split(
        [3 * k, 6, layout.features, k, 7 * k, 3 * k], 1
    )
    raw_opacity, shape, color = heads(features if seen_from is None else torch.cat([features, seen_from], 1))
    raw_opacity = raw_opacity + row_opacity
    valid = raw_opacity > float(RAW_OPACITY_MIN)
    if present is not None:
        valid = valid & present[:, None]
    # The clamp passes the gradient, so that an extent beyond the limit can return.
    extent = (extents + (extents.clamp(max=LOG_EXTENT_MAX) - extents).detach()).exp()
    raw_scale, quats = (shape + row_shape).view(n, k, 7).split([3, 4], 2)
    means = positions[:, None] + offsets.view(n, k, 3) * extent[:, None, :3]
    scales = extent[:, None, 3:] * raw_scale.sigmoid()
    sh = color.view(n, k, -1, 3)
    sh = torch.cat([sh[:, :, :1] + row_color.view(n, k, 1, 3), sh[:, :, 1:]], 2)
    return Generated(
        means.reshape(-1, 3), quats.reshape(-1, 4), scales.reshape(-1, 3),
        torch.where(valid, raw_opacity.tanh(), 0.0).reshape(-1), sh.reshape(n * k, -1, 3),
        ids[:, None].expand(n, k).reshape(-1), torch.arange(n * k, device=rows.device), valid.reshape(-1),
    )  # fmt: skip


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
    if devices.on_gpu(rows):
        return _on_gpu(layout, positions, rows, ids, heads, seen_from, present)
    layers = (heads.hidden, heads.opacity, heads.shape, heads.color)
    parameters = [p for layer in layers for p in (layer.weight, layer.bias)]
    if seen_from is None:
        seen_from = positions.new_empty((len(positions), 0))
    *tensors, source = Generate.apply(positions, rows, seen_from, layout, *parameters)
    means, quats, scales, opacities, sh = tensors
    return Generated(means, quats, scales, opacities, sh, ids[source // layout.offsets], source)
