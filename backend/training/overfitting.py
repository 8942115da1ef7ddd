"""Detection of overfitting with few views, and dropout of splats against it.

Splats can fit a few photos exactly without fitting the scene. It shows in views that the training does not see: their
PSNR falls, while that of its own photos rises. Some training views are therefore spared during the first part of a
training, and join the others afterward. If their PSNR has fallen, each further step renders a random half of the
splats, so that none can rely on the others (DropGaussian, Park et al. 2025). Without overfitting, this would cost
quality, so it is not the default.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from .budget import WARM_UP, Budget, TrainingProgress

if TYPE_CHECKING:
    from ..model.generate import Generated

WATCHED = 3
"""Number of views that are spared."""

POINTS_PER_VIEW = 100
"""Number of points per training view from which on no view is spared: with more points, few
trainings overfit, and three spared views of twelve cost quality."""

FEWEST, MOST = 3 * WATCHED, 60
"""Numbers of training views from which and up to which some are spared."""

UNTIL, UNTIL_STEP = 0.35, 3 * WARM_UP
"""Progress up to which they are spared; for a training until convergence, the number of steps, or until then."""

FALL_DB = 0.2
"""The training overfits if the mean PSNR of the spared views has fallen by more than this below its maximum."""

DROPPED = 0.5
"""Probability with which a splat is left out of a step against overfitting."""

DROPPED_UNTIL = 0.98
"""Progress up to which splats are left out; the last steps fit the opacities of all splats together."""

OVERFITS = (
    "Views that were spared at first fit less and less well, so each step leaves out half of the splats from here on, "
    "which reduces overfitting"
)


@dataclass(frozen=True)
class Dropout:
    """Leaves out each splat of a step with a probability.

    Attributes:
        rate: the probability.
        seed: seed of the random numbers, another one for each step.
    """

    rate: float
    seed: int

    def __call__(self, splats: Generated) -> Generated:
        """Return the splats, with the opacity of those that are left out set to 0."""
        generator = torch.Generator(splats.opacities.device).manual_seed(self.seed)
        kept = torch.rand(splats.opacities.shape, generator=generator, device=splats.opacities.device) >= self.rate
        return splats._replace(opacities=splats.opacities * kept)


def choose_watched_views(training: Sequence[int], points: int) -> list[int]:
    """Choose the views to spare at first, spread evenly over the training views.

    Args:
        training: indices of the training views.
        points: number of the capture's points.

    Returns:
        Their indices; empty if the capture is unlikely to be overfitted, or has too few views to spare some.
    """
    count = len(training)
    if not FEWEST <= count <= MOST or points >= POINTS_PER_VIEW * count:
        return []
    return [training[(2 * i + 1) * count // (2 * WATCHED)] for i in range(WATCHED)]


def watch(p: TrainingProgress, budget: Budget) -> bool:
    """Turn dropout on if the spared views show overfitting, and let them join the others when their time has come.

    Returns:
        Whether dropout begins now.
    """
    if not p.watched:
        return False
    if _has_fallen(p.curve):
        p.dropped = DROPPED
    ends = p.step >= UNTIL_STEP or p.converged_at > 0 if budget.until_converged else budget.progress(p) >= UNTIL
    if p.dropped or ends:
        p.watched = []
    return p.dropped > 0


def dropout_at(p: TrainingProgress, progress: float, step: int) -> Dropout | None:
    """Return the dropout of the step after so many others, or None."""
    return Dropout(p.dropped, step) if p.dropped and progress < DROPPED_UNTIL else None


def _has_fallen(curve: Sequence[dict[str, Any]]) -> bool:
    found = [entry["watched_psnr"] for entry in curve if entry.get("watched_psnr") is not None]
    return bool(found) and found[-1] < max(found) - FALL_DB
