"""Adam for the rows of the anchors, with the moments of all that are trained."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from ...model.anchors import kept_and_added
from ...raster import devices
from .adam import BETA1, BETA2, direction, step_rows

_PREFIX = "adam."


class RowAdam:
    """The moments of a model's rows.

    Args:
        rows: (N, columns) float32.
        fixed: number of rows, the first ones, that are not trained and have no moments.
        tensors: tensors of a checkpoint, of which the moments are taken; on the CPU, they share their memory.

    Attributes:
        exp_avg, exp_avg_sq: (N - fixed, columns) float32.
    """

    def __init__(self, rows: torch.Tensor, fixed: int, tensors: Mapping[str, np.ndarray] | None = None) -> None:
        self._fixed = fixed
        self.exp_avg, self.exp_avg_sq = (
            torch.zeros_like(rows[fixed:]) if tensors is None else torch.from_numpy(tensors[name]).to(rows.device)
            for name in (_PREFIX + "exp_avg", _PREFIX + "exp_avg_sq")
        )

    def step(
        self,
        rows: torch.Tensor,
        seen: torch.Tensor,
        gradients: torch.Tensor,
        rates: np.ndarray,
        number: int,
        usable: torch.Tensor | None,
    ) -> torch.Tensor:
        """Perform one step in place, except on fixed rows.

        Args:
            rows: (N, columns), the rows.
            seen: (n,) int64, indices of the rows with gradients, on the CPU ascending.
            gradients: (n, columns).
            rates: (columns,) float32, the learning rates.
            number: of the step, from 1 on.
            usable: as for `step_rows`, whose result is returned.
        """
        fixed = self._fixed
        if fixed and usable is not None:
            # Selecting rows would synchronize with the GPU; row 0 stands for fixed ones, which are not changed.
            seen, usable = (seen - fixed).clamp_(min=0), usable & (seen >= fixed)
        elif fixed:
            first = int(torch.searchsorted(seen, fixed))
            seen, gradients = seen[first:] - fixed, gradients[first:]
        return step_rows(
            rows[fixed:], self.exp_avg, self.exp_avg_sq, seen, gradients, rates, 1 - BETA1**number, 1 - BETA2**number,
            usable,
        )  # fmt: skip

    def expected_change(self, seen: torch.Tensor, rates: np.ndarray, number: int) -> torch.Tensor:
        """Return the change of rows that a step is expected to make, by the mean of their gradients so far.

        Args:
            seen: (n,) int64, indices of the rows, none of which is fixed.
            rates: (columns,) float32, the learning rates.
            number: number of steps so far.

        Returns:
            (n, columns).
        """
        if not number:
            return self.exp_avg.new_zeros((len(seen), self.exp_avg.shape[1]))
        change = direction(self.exp_avg[seen], self.exp_avg_sq[seen], 1 - BETA1**number, 1 - BETA2**number)
        return change.mul_(devices.upload(-rates, change))

    def take(self, kept: torch.Tensor, added: int) -> None:
        """Apply a change of the anchors.

        Args:
            kept: (n,) int64, indices of the rows that are kept, not counting fixed ones.
            added: number of rows that are appended.
        """
        for name in ("exp_avg", "exp_avg_sq"):
            moments = getattr(self, name)
            setattr(self, name, kept_and_added(moments, kept, moments.new_zeros((added, moments.shape[1]))))

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the moments as tensors for a checkpoint."""
        return {f"{_PREFIX}exp_avg": self.exp_avg, f"{_PREFIX}exp_avg_sq": self.exp_avg_sq}
