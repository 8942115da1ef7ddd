"""Conversion of 3D Gaussians to discs, without their smallest axis."""

from __future__ import annotations

import copy
from dataclasses import replace

import torch

from ..shared.splats.blending import EPS_2D
from .anchors import LOG_EXTENT_MAX
from .object_model import ObjectModel

_TURNS = ((0.5, 0.5, 0.5, 0.5), (0.5, -0.5, -0.5, -0.5), (1.0, 0.0, 0.0, 0.0))
_ORDERS = ((1, 2, 0), (2, 0, 1), (0, 1, 2))
"""For each smallest axis, the rotation (quaternion w, x, y, z) and the order of axes that make it the third one."""

_MARGIN = 1.02
_LEAST, _MOST = 1e-5, 0.99
"""Factor by which an anchor's extent exceeds its largest scale, and the limits of a scale as a fraction of it."""


def to_discs(model: ObjectModel) -> ObjectModel:
    """Convert a model of 3D Gaussians to one of discs, each perpendicular to the smallest axis of its Gaussian.

    Args:
        model: an explicit model of 3D Gaussians.

    Returns:
        A model of discs with the same positions, colors and opacities; it shares only positions and IDs with `model`.

    Raises:
        ValueError: the model depends on the view, or consists of discs.
    """
    if not model.explicit or model.primitive != "3d":
        raise ValueError("only explicit models of 3D Gaussians can be converted to discs")
    anchors, layout = model.anchors, model.anchors.layout
    rows = anchors.rows.detach().clone()
    count, scale_columns = len(rows), layout.scale_columns
    with torch.no_grad():
        _, of_heads, _ = model.heads(rows[:, layout.feature_columns])
        shape = (of_heads + rows[:, layout.shape_columns]).view(count, layout.offsets, 7)
        extents = rows[:, scale_columns].clamp(max=LOG_EXTENT_MAX).exp()
        scales = extents[:, None] * shape[..., :3].sigmoid()
        smallest = scales.argmin(-1)
        order = torch.tensor(_ORDERS, device=rows.device)[smallest]
        turn = torch.tensor(_TURNS, device=rows.device)[smallest]
        # One extent for all axes, since the axes of a splat change places.
        extent = _MARGIN * extents.amax(1, keepdim=True)
        fraction = (scales.gather(-1, order) / extent[:, None]).clamp(_LEAST, _MOST)
        turned = torch.cat([fraction.logit(), _product(shape[..., 3:], turn)], -1)
        rows[:, layout.shape_columns] = turned.reshape(count, -1) - of_heads
        rows[:, scale_columns] = extent.log()
    return replace(
        model, anchors=replace(anchors, rows=rows), heads=copy.deepcopy(model.heads),
        background=model.background.detach().clone(), primitive="2d", blur=EPS_2D,
    )  # fmt: skip


def _product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the product of quaternions (..., 4)."""
    w, x, y, z = a.unbind(-1)
    p, q, r, s = b.unbind(-1)
    return torch.stack(
        [
            w * p - x * q - y * r - z * s,
            w * q + x * p + y * s - z * r,
            w * r - x * s + y * p + z * q,
            w * s + x * r - y * q + z * p,
        ],
        -1,
    )
