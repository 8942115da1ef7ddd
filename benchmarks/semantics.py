"""Alternatives to the one-hot ID loss of ObjectGS (section 3.3), for comparison; see benchmarks/ablations.py.

`learnable`: each anchor's feature is encoded to CHANNELS values, which are blended like colors; a linear decoder maps
the blended values of a pixel to its object (as in Gaussian Grouping). `independent`: each object is rendered alone, and
its alpha is compared with its mask. Both have the weight of the one-hot loss, and start from the same anchors.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from backend.model.generate import Generated
from backend.model.object_model import ObjectModel, anchors_in_view
from backend.raster import Camera, rasterize
from backend.shared.splats.spherical_harmonics import C0
from backend.training import overfitting, step, trainer
from backend.training.losses.on_cpu import PROBABILITY_FLOOR
from benchmarks import shared

CHANNELS = 12
RATE = 5e-3
"""Learning rate of the encoder and the decoder."""

OPAQUE = 0.5
"""Alpha from which on a pixel belongs to an object that is rendered alone."""


class _WithoutLabels(step.ViewStep):
    """A training step whose label loss is replaced by `_semantic_loss`."""

    def _terms(self, part: Any, seen: Any, rows: Any, *others: Any) -> Any:
        terms, g, drawn = super()._terms(part._replace(labels=None), seen, rows, *others)
        if part.labels is not None and bool((part.labels >= 0).any()):
            loss = self._semantic_loss(g, rows, part.camera, part.labels)
            terms["the semantic loss"] = self.settings.semantic_weight * loss
        return terms, g, drawn

    def _semantic_loss(self, g: Generated, rows: torch.Tensor, camera: Camera, labels: torch.Tensor) -> torch.Tensor:
        raise NotImplementedError


class LearnableStep(_WithoutLabels):
    """Semantic features, blended and decoded per pixel."""

    def __init__(self, *arguments: Any, **words: Any) -> None:
        super().__init__(*arguments, **words)
        generator = torch.Generator().manual_seed(self.settings.seed)
        self.encoder = nn.Linear(self.settings.layout.features, CHANNELS)
        self.decoder = nn.Linear(CHANNELS, len(self.model.classes))
        with torch.no_grad():
            for layer in (self.encoder, self.decoder):
                layer.weight.normal_(0, layer.in_features**-0.5, generator=generator)
                layer.bias.zero_()
        self._optimizer = torch.optim.Adam([*self.encoder.parameters(), *self.decoder.parameters()], RATE)

    def compute(
        self, index: int, progress: float, dropout: overfitting.Dropout | None = None, alone: bool = False
    ) -> step.ViewGradients | None:
        """Compute the gradients of a view, and update encoder and decoder."""
        self._optimizer.zero_grad()
        found = super().compute(index, progress, dropout, alone)
        if found is not None:
            self._optimizer.step()
        return found

    def decode(self, g: Generated, rows: torch.Tensor, camera: Camera) -> torch.Tensor:
        """Return the logits (classes, H, W) of a view's pixels."""
        layout = self.settings.layout
        values = self.encoder(rows[:, layout.feature_columns]).sigmoid()[g.source // layout.offsets]
        planes = [
            rasterize(
                g.means, g.quats, g.scales, g.opacities, ((values[:, at : at + 3] - 0.5) / C0)[:, None], g.ids, camera,
                primitive=self.settings.primitive,
            ).color
            for at in range(0, CHANNELS, 3)
        ]  # fmt: skip
        return torch.movedim(self.decoder(torch.movedim(torch.cat(planes), 0, -1)), -1, 0)

    def _semantic_loss(self, g: Generated, rows: torch.Tensor, camera: Camera, labels: torch.Tensor) -> torch.Tensor:
        logits = self.decode(g, rows, camera)
        return functional.cross_entropy(logits[None], labels[None].long(), ignore_index=-1)

    def ids(self, model: ObjectModel, camera: Camera) -> np.ndarray:
        """Return the object IDs (H, W) of a view."""
        seen = anchors_in_view(model.anchors, *step.frustum(camera))
        with torch.no_grad():
            logits = self.decode(model.generate(seen, camera.center), model.anchors.rows[seen], camera)
        return model.classes.ids_of(logits.argmax(0).numpy())


class IndependentStep(_WithoutLabels):
    """Each object rendered alone, its alpha compared with its mask."""

    def _semantic_loss(self, g: Generated, rows: torch.Tensor, camera: Camera, labels: torch.Tensor) -> torch.Tensor:
        labeled = labels >= 0
        losses = []
        for value in torch.unique(labels[labeled]).tolist():
            alpha = _alone(g, g.ids == value, camera, self.settings.primitive)
            right = torch.where(labels == value, alpha, 1 - alpha)[labeled]
            losses.append(-((right + PROBABILITY_FLOOR) / (1 + PROBABILITY_FLOOR)).log().mean())
        return torch.stack(losses).mean()


def _alone(g: Generated, which: torch.Tensor, camera: Camera, primitive: str) -> torch.Tensor:
    """Return the alpha (H, W) of some of the Gaussians without the others."""
    only = g.select(which)
    return rasterize(*only[:6], camera, primitive=primitive).alpha


def iou_alone(model: ObjectModel, camera: Camera, truth: np.ndarray) -> dict[int, tuple[int, int]]:
    """Return the intersection and union, in pixels, of each object rendered alone with its true mask in a view."""
    seen = anchors_in_view(model.anchors, *step.frustum(camera))
    g = model.generate(seen, camera.center)
    found = {}
    for value in np.unique(truth[truth > 0]).tolist():
        number = int(model.classes.classes_of(np.array([value]))[0])
        shown = _alone(g, g.ids == number, camera, model.primitive).numpy() >= OPAQUE
        true = truth == value
        found[value] = int((shown & true).sum()), int((shown | true).sum())
    return found


STEPS = {"one-hot": step.ViewStep, "learnable": LearnableStep, "independent": IndependentStep}


def use(name: str) -> None:
    """Let trainers of this process train the semantics `name`, a key of STEPS."""
    shared.replace(trainer, "ViewStep", STEPS[name])
