"""Schedule and statistics of the growing and pruning of anchors in training (Scaffold-GS section 3.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import NamedTuple

import numpy as np
import torch

from ..model.growth import Growth, GrowthStatistics, grow_and_prune
from ..model.object_model import ObjectModel
from .cells.region import Region
from .settings import GROW_FROM, GROW_UNTIL, Settings, growth_interval

_PREFIX = "growth."


class ViewStatistics(NamedTuple):
    """Statistics of a rendered image, or of a part of one.

    Attributes:
        anchors: (n,) int64, the anchors in view.
        source: (S,) int64, for each splat the index of its anchor in `anchors` * offsets + its offset.
        opacities: (S,), opacities of the splats.
        drawn: (S,) bool, the splats that overlap the image.
        screen_gradient: (S, 2), gradient of the loss with respect to the splats' centers in pixels.
        usable: (n,) bool, on the GPU, of an image that is rendered in one part: anchors for which it is False are
            ignored.
    """

    anchors: torch.Tensor
    source: torch.Tensor
    opacities: torch.Tensor
    drawn: torch.Tensor | np.ndarray
    screen_gradient: torch.Tensor | np.ndarray
    usable: torch.Tensor | None = None

    @classmethod
    def of_view(
        cls, parts: Sequence[ViewStatistics], offsets: int, usable: torch.Tensor | None
    ) -> ViewStatistics | None:
        """Return the statistics of an image; None without any of its parts.

        Args:
            parts: statistics of the parts in which the image was rendered.
            offsets: number of splats per anchor.
            usable: as the attribute, for an image in one part.
        """
        if len(parts) > 1:
            return cls.together(parts, offsets)
        return parts[0]._replace(usable=usable) if parts else None

    @classmethod
    def together(cls, parts: Sequence[ViewStatistics], offsets: int) -> ViewStatistics:
        """Merge the statistics of the parts of an image, on the GPU.

        A splat that overlaps several parts counts once; its gradients are summed.
        """
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
    """Accumulates statistics of the training views, and grows and prunes anchors at intervals.

    Args:
        settings: settings of the training.
        model: the model.
        region: the part of the model that is trained.
        tensors: tensors of a checkpoint, of which the statistics are taken; on the CPU, they share their memory.
    """

    def __init__(
        self, settings: Settings, model: ObjectModel, region: Region, tensors: Mapping[str, np.ndarray] | None = None
    ) -> None:
        self._settings = settings
        self._region = region
        self.statistics = (
            self._cleared(model)
            if tensors is None
            else GrowthStatistics(
                *(
                    torch.from_numpy(tensors[_PREFIX + field.name]).to(model.device)
                    for field in fields(GrowthStatistics)
                )
            )
        )

    def observes(self, progress: float) -> bool:
        """Return whether statistics are accumulated at this progress, 0 .. 1; this starts before growth."""
        return GROW_FROM / 2 <= progress < GROW_UNTIL

    def observe(self, view: ViewStatistics, offsets: int, size: tuple[int, int]) -> None:
        """Add the statistics of a view.

        Args:
            view: the statistics.
            offsets: number of splats per anchor.
            size: width and height of the whole image in pixels.
        """
        self.statistics.add(
            view.anchors, offsets, view.source, view.opacities, view.drawn, view.screen_gradient, *size, view.usable
        )

    def is_due(self, progress: float, step: int, last_growth: int) -> bool:
        """Return whether growth is due after `step`; last_growth: as from `counted_from`."""
        return progress >= GROW_FROM and step - last_growth >= growth_interval(step)

    def counted_from(self, step: int, last_growth: int, views: int) -> int:
        """Return the step from which the interval to the next growth is counted, after a growth at `step`.

        It is the step at which the growth was due, since several steps that are made together may go past it; `step`
        itself, if growth was put off for other reasons.

        Args:
            step: number of steps so far.
            last_growth: the step from which the interval to this growth was counted.
            views: number of steps that are made together.
        """
        late = step - last_growth - growth_interval(step)
        return step - late if late < views else step

    def grow(self, model: ObjectModel, rng: np.random.Generator) -> Growth:
        """Grow and prune the model's anchors in place, based on the accumulated statistics."""
        anchors = model.anchors
        region = self._region
        growth = grow_and_prune(
            anchors, self.statistics, rng, max_anchors=self._settings.max_anchors, fixed=region.fixed,
            allows=None if region.is_whole else region.contains,
        )  # fmt: skip
        self.statistics = self.statistics.after(growth, anchors.layout.offsets)
        return growth

    def clear(self, model: ObjectModel) -> None:
        """Reset the statistics after the model's anchors were changed by other means."""
        self.statistics = self._cleared(model)

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the statistics as tensors for a checkpoint."""
        return {_PREFIX + field.name: getattr(self.statistics, field.name) for field in fields(GrowthStatistics)}

    @staticmethod
    def _cleared(model: ObjectModel) -> GrowthStatistics:
        return GrowthStatistics.zeros(len(model.anchors), model.anchors.layout.offsets, model.device)
