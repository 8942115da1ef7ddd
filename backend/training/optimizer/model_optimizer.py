"""All that changes a model in training: Adam steps, the mean over the latest steps, growth, and removal of anchors."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING

import numpy as np
import torch

from ..cells.region import Region
from ..check_finite import Fault, FiniteCheck, find_fault_of_heads, find_fault_of_rows
from ..growth_strategy import GrowthStrategy
from ..settings import HEAD_RATES, Settings, rate, row_rates
from .average import Average
from .head_adam import HeadAdam
from .row_adam import RowAdam

if TYPE_CHECKING:
    from ...model.object_model import ObjectModel
    from ..step import ViewGradients


class ModelOptimizer:
    """Updates a model with the gradients of views.

    Args:
        model: the model, which is changed in place.
        settings: settings of the training.
        region: the part of the model that is trained.
        tensors: tensors of a checkpoint, from which the training goes on; None at its start.

    Attributes:
        rows, heads: Adam of the anchors' rows, and of the heads and the background.
        average: the mean of the model over the latest steps.
        growth: statistics and schedule of growth.
        check: counts updates that are not finite.
    """

    def __init__(
        self, model: ObjectModel, settings: Settings, region: Region, tensors: Mapping[str, np.ndarray] | None = None
    ) -> None:
        self._model = model
        self._settings = settings
        self._region = region
        self.rows = RowAdam(model.anchors.rows, region.fixed, tensors)
        self.average = Average.from_checkpoint(tensors or {}, model, region.fixed)
        model.background.requires_grad_(settings.background == "learned" and region.is_whole)
        model.heads.requires_grad_(region.is_whole)
        names = [name for name in HEAD_RATES if name != "background"]
        heads = {name: list(getattr(model.heads, name).parameters()) for name in names}
        self.heads = HeadAdam({**heads, "background": [model.background]})
        self.heads.restore(tensors or {})
        self.growth = GrowthStrategy(settings, model, region, tensors)
        self.check = FiniteCheck(model.device)

    @property
    def is_complete(self) -> bool:
        """Whether all parts have the same anchors, unlike after a growth or a removal that has failed half way."""
        a, fixed = self._model.anchors, self._region.fixed
        trained = [len(values) + fixed for values in (self.rows.exp_avg, self.rows.exp_avg_sq, self.average.rows)]
        return len({len(a.positions), len(a.rows), len(a.ids), len(self.growth.statistics.views), *trained}) == 1

    def update(self, gradients: ViewGradients, progress: float, step: int) -> None:
        """Update the model with the gradients of a view.

        Args:
            gradients: of the view.
            progress: progress of the training, 0 .. 1, which determines the learning rates.
            step: number of the step, from 1 on.
        """
        optimizer, anchors = self.heads, self._model.anchors
        skipped: int | torch.Tensor = 0 if gradients.finite is None else ~gradients.finite
        if self._region.is_whole:
            optimizer.gradients = gradients.heads
            rates = {name: rate(HEAD_RATES[name], progress) for name in optimizer.groups}
            skipped = ~optimizer.step(rates, gradients.finite)
        if gradients.in_view is not None:
            # There is nothing to update for a photo that shows no anchor.
            skipped = skipped & (gradients.in_view > 0)
        skipped = skipped + self.rows.step(
            anchors.rows, gradients.seen, gradients.rows, row_rates(self._settings, progress), step, gradients.usable
        )
        self.check.skipped += skipped
        if self.check.at_once and skipped:
            values = anchors.rows.index_select(0, gradients.seen)
            self.check.fault = find_fault_of_rows(
                gradients.rows, values, gradients.seen, self._settings.layout
            ) or find_fault_of_heads(self._gradients_of_heads())
        self.average.follow(self._model, step)

    def expected_changes(self, seen: torch.Tensor, count: int, progress: float, step: int) -> torch.Tensor:
        """Return how the rows of anchors will change in the next steps, by their moments (Chen et al. 2018, SpecTrain).

        Gradients of a view that are applied after those of other views are better computed where the rows will be then.

        Args:
            seen: (n,) int64, the anchors, none of which is fixed.
            count: number of steps ahead.
            progress: progress of the training, 0 .. 1.
            step: number of steps so far.

        Returns:
            (n, columns).
        """
        return count * self.rows.expected_change(seen, row_rates(self._settings, progress), step)

    def heads_ahead(self, count: int, progress: float) -> AbstractContextManager[None]:
        """Let the heads be where they are expected in `count` steps; see `expected_changes`."""
        if not count:
            return nullcontext()
        return self.heads.ahead(count, {name: rate(HEAD_RATES[name], progress) for name in self.heads.groups})

    def _gradients_of_heads(self) -> dict[str, list[torch.Tensor]]:
        return {
            name: [parameter.grad for parameter in group if parameter.grad is not None]
            for name, group in self.heads.groups.items()
        }

    def remove(self, faults: list[Fault]) -> bool:
        """Remove the anchors that have caused faults and cannot recover; return whether there were any."""
        numbers = [fault.unrecoverable for fault in faults if len(fault.unrecoverable)]
        if not numbers:
            return False
        a, fixed = self._model.anchors, self._region.fixed
        kept = torch.ones(len(a), dtype=torch.bool, device=self._model.device)
        kept[torch.cat(numbers)] = False
        # Those were finite before the training, and are none of its business.
        kept[:fixed] = True
        a.positions, a.rows, a.ids = a.positions[kept], a.rows[kept], a.ids[kept]
        kept = kept[fixed:].nonzero()[:, 0]
        self.rows.take(kept, 0)
        self.average.take(kept, a.rows[:0])
        self.growth.clear(self._model)
        return True

    def grow(self, rng: np.random.Generator) -> None:
        """Grow and prune the anchors by the statistics of the views so far."""
        anchors, fixed = self._model.anchors, self._region.fixed
        growth = self.growth.grow(self._model, rng)
        # All fixed anchors are kept.
        kept = growth.kept[fixed:] - fixed
        self.rows.take(kept, growth.added)
        self.average.take(kept, anchors.rows[len(anchors) - growth.added :])
