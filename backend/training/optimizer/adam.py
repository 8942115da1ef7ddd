"""Sparse Adam: updates only the rows used in a step, in one pass over memory.

Unused rows keep their values and moments (Mallick et al. 2024, "Taming 3DGS"), so the cost of a step depends on the
number of visible anchors instead of all anchors.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import prange

from ...gpu.kernel import WARP
from ...gpu.kernel import kernel as gpu_kernel
from ...raster import devices
from ...raster.kernel import kernel

BETA1 = 0.9
BETA2 = 0.999
EPSILON = 1e-15

LARGEST_GRADIENT = 1e19
"""Gradients above this limit are rejected, since their square would overflow exp_avg_sq and freeze the parameter."""

_ROWS_PER_BLOCK = 4
"""Number of rows that a block of the GPU's kernel updates, each by a warp."""


def step_rows(
    values: torch.Tensor,
    exp_avg: torch.Tensor,
    exp_avg_sq: torch.Tensor,
    seen: torch.Tensor,
    gradients: torch.Tensor,
    rates: np.ndarray,
    correction1: float,
    correction2: float,
    usable: torch.Tensor | None = None,
) -> torch.Tensor:
    """Perform one step of Adam in place (Kingma and Ba 2015, algorithm 1).

    Args:
        values: (N, D) float32.
        exp_avg, exp_avg_sq: (N, D) float32, the moments.
        seen: (n,) int64, indices of the rows to update, each once.
        gradients: (n, D), gradients of these rows.
        rates: (D,) float32, the learning rate of each column.
        correction1, correction2: 1 - BETA1**t and 1 - BETA2**t for the step count t.
        usable: (n,) bool, only on the GPU: rows for which it is False are not changed.

    Returns:
        The number () int64 of usable rows that were not changed because their gradient is not finite or exceeds
        LARGEST_GRADIENT.
    """
    if not devices.on_gpu(values):
        arrays = (t.numpy() for t in (values, exp_avg, exp_avg_sq, seen, gradients))
        return torch.tensor(_step_rows(*arrays, rates, correction1, correction2))
    bad = torch.zeros((), dtype=torch.int64, device=values.device)
    constants = {"BETA1": BETA1, "BETA2": BETA2, "EPSILON": EPSILON, "LARGEST_GRADIENT": LARGEST_GRADIENT}
    gpu_kernel("step_rows", ROWS_PER_BLOCK=_ROWS_PER_BLOCK, **constants)(
        math.ceil(len(seen) / _ROWS_PER_BLOCK), _ROWS_PER_BLOCK * WARP, values, exp_avg, exp_avg_sq, seen, gradients,
        usable, devices.upload(rates, values), 1 / correction1, 1 / correction2, len(seen), values.shape[1], bad,
    )  # fmt: skip
    return bad


@kernel(parallel=True)
def _step_rows(values, exp_avg, exp_avg_sq, seen, gradients, rates, correction1, correction2):
    bad = np.zeros(seen.size, np.int64)
    b1, b2 = np.float32(BETA1), np.float32(BETA2)
    one, largest = np.float32(1.0), np.float32(LARGEST_GRADIENT)
    c1 = np.float32(1.0 / correction1)
    c2 = np.float32(1.0 / correction2)
    for i in prange(seen.size):
        row = seen[i]
        usable = True
        for j in range(values.shape[1]):
            # False for NaN.
            usable &= abs(gradients[i, j]) < largest
        if not usable:
            bad[i] = 1
            continue
        for j in range(values.shape[1]):
            g = gradients[i, j]
            new_exp_avg = b1 * exp_avg[row, j] + (one - b1) * g
            new_exp_avg_sq = b2 * exp_avg_sq[row, j] + (one - b2) * g * g
            exp_avg[row, j] = new_exp_avg
            exp_avg_sq[row, j] = new_exp_avg_sq
            values[row, j] -= rates[j] * (new_exp_avg * c1) / (np.sqrt(new_exp_avg_sq * c2) + np.float32(EPSILON))
    return bad.sum()


def direction(
    exp_avg: torch.Tensor,
    exp_avg_sq: torch.Tensor,
    correction1: float | torch.Tensor,
    correction2: float | torch.Tensor,
) -> torch.Tensor:
    """Return the change of values in a step with these moments, for a learning rate of -1; arguments as `step_rows`."""
    return (exp_avg / correction1).div_((exp_avg_sq / correction2).sqrt_().add_(EPSILON))


def take_rows(values: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
    """Return values[seen], (n, D), for values (N, D) and seen (n,) int64."""
    return values[seen] if devices.on_gpu(values) else torch.from_numpy(_take_rows(values.numpy(), seen.numpy()))


@kernel(parallel=True)
def _take_rows(values, seen):
    out = np.empty((seen.size, values.shape[1]), values.dtype)
    for i in prange(seen.size):
        row = seen[i]
        for j in range(values.shape[1]):
            out[i, j] = values[row, j]
    return out
