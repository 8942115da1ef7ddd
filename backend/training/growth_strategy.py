"""When anchors are grown and pruned during training, and on what evidence (Scaffold-GS section 3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from ..model.growth import Growth, GrowthStatistics, grow_and_prune
from ..model.object_model import ObjectModel
from .settings import GROW_FROM, GROW_UNTIL, Settings, growth_interval


class ViewStatistics(NamedTuple):
    """Statistics of a rendered image, or of a part of one.

    Attributes:
        anchors: (n,) int64, the anchors in view.
        source: (S,) int64, for each splat the index of its anchor in `anchors` * offsets + its offset.
        opacities: (S,) of the splats.
        drawn: (S,) bool, the splats that touch the image.
        screen_gradient: (S, 2), the gradient of the loss by the splats' position on the screen, per pixel.
    """

    anchors: torch.Tensor
    source: torch.Tensor
    opacities: torch.Tensor
    drawn: torch.Tensor | np.ndarray
    screen_gradient: torch.Tensor | np.ndarray

    @classmethod
    def together(cls, parts: Sequence[ViewStatistics], offsets: int) -> ViewStatistics:
        """The parts of an image as one, on the GPU: a splat that touches several of them counts once, and its gradient
        is the sum of theirs."""
        anchors = torch.cat([part.anchors for part in parts]).unique()
        opacities = parts[0].opacities.new_zeros((len(anchors), offsets))
        drawn, gradient = torch.zeros_like(opacities, dtype=torch.bool), opacities.new_zeros((len(anchors), offsets, 2))
        for part in parts:
            where = torch.searchsorted(anchors, part.anchors)
            opacities[where] = part.opacities.view(-1, offsets)
            drawn[where] |= torch.as_tensor(part.drawn).view(-1, offsets)
            gradient[where] += torch.as_tensor(part.screen_gradient).view(-1, offsets, 2)
        source = torch.arange(drawn.numel(), device=drawn.device)
        return cls(anchors, source, opacities.flatten(), drawn.flatten(), gradient.view(-1, 2))


class GrowthStrategy:
    """Gathers statistics of the views that are trained on, and grows and prunes anchors at regular steps."""

    def __init__(self, settings: Settings, model: ObjectModel) -> None:
        self._settings = settings
        self.statistics = self._cleared(model)

    def observes(self, progress: float) -> bool:
        """Whether views at this progress of the training, 0 .. 1, count for growth; they do so before it begins."""
        return GROW_FROM / 2 <= progress < GROW_UNTIL

    def observe(
        self, parts: Sequence[ViewStatistics], offsets: int, width: int, height: int, usable: torch.Tensor | None
    ) -> None:
        """Add the statistics of a view.

        Args:
            parts: of the image of width x height pixels, which may be rendered in several.
            offsets: splats of an anchor.
            usable: (n,) bool, on the GPU, where the image is rendered as a whole: the other anchors do not count.
        """
        if not parts:
            return
        whole = len(parts) == 1
        view = parts[0] if whole else ViewStatistics.together(parts, offsets)
        self.statistics.add(
            view.anchors, offsets, view.source, view.opacities, view.drawn, view.screen_gradient, width, height,
            usable if whole else None,
        )  # fmt: skip

    def is_due(self, progress: float, step: int, last_growth: int) -> bool:
        """Whether anchors are to be grown after `step`; last_growth: the step after which they were last."""
        return progress >= GROW_FROM and step - last_growth >= growth_interval(step)

    def grow(self, model: ObjectModel, rng: np.random.Generator) -> Growth:
        """Grow and prune the model's anchors in place by the statistics so far."""
        anchors = model.anchors
        growth = grow_and_prune(anchors, self.statistics, rng, max_anchors=self._settings.max_anchors)
        self.statistics = self.statistics.after(growth, anchors.layout.offsets)
        return growth

    def clear(self, model: ObjectModel) -> None:
        """Forget the statistics, for a model whose anchors have changed otherwise."""
        self.statistics = self._cleared(model)

    @staticmethod
    def _cleared(model: ObjectModel) -> GrowthStatistics:
        return GrowthStatistics.zeros(len(model.anchors), model.anchors.layout.offsets, model.device)
