"""MLP heads that map an anchor's feature to the parameters of its splats (Scaffold-GS; ObjectGS section 3.2)."""

from __future__ import annotations

import torch
from torch import nn

from .anchors import Layout

HIDDEN = 32


class Heads(nn.Module):
    """Opacity, shape and color heads, 32 hidden units each.

    In `explicit` mode the only input is the anchor's feature, and colors are spherical harmonics of degree `sh_degree`,
    so the model can be exported as plain splats without loss. In the modes `view` and `paper`, the distance and
    direction from the camera are additional inputs, and each splat has a single color.
    """

    def __init__(self, layout: Layout, mode: str, sh_degree: int, generator: torch.Generator) -> None:
        super().__init__()
        self.view_dependent = mode != "explicit"
        self.coefficients = 1 if self.view_dependent else (sh_degree + 1) ** 2
        self.inputs = layout.features + (4 if self.view_dependent else 0)
        k = layout.offsets
        self.hidden = nn.Linear(self.inputs, 3 * HIDDEN)
        self.opacity = nn.Linear(HIDDEN, k)
        self.shape = nn.Linear(HIDDEN, 7 * k)
        self.color = nn.Linear(HIDDEN, 3 * self.coefficients * k)
        with torch.no_grad():
            for layer in (self.hidden, self.opacity, self.shape, self.color):
                bound = layer.in_features**-0.5
                layer.weight.uniform_(-bound, bound, generator=generator)
                layer.bias.zero_()
            self.hidden.bias.uniform_(-0.5, 0.5, generator=generator)
            self.opacity.weight.mul_(0.3)
            self.color.weight.mul_(0.1)
            self.shape.bias.view(k, 7)[:, 3] = 1.0
            self.opacity.bias.fill_(0.2)

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Map features (n, inputs) to opacity (n, k), shape (n, 7 k), color (n, 3 K k), all before activation."""
        hidden = torch.relu(self.hidden(features))
        opacity, shape, color = hidden.split(HIDDEN, 1)
        return self.opacity(opacity), self.shape(shape), self.color(color)
