"""Adam on the rows that a step saw, in one pass over memory.

A row that was not seen keeps its value and moments (Mallick et al. 2024, "Taming 3DGS"), so a step costs what is
visible, not what exists.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import prange

from .. import device
from ..raster.kernel import kernel

BETA1 = 0.9
BETA2 = 0.999
EPSILON = 1e-15

LARGEST_GRADIENT = 1e19
"""The square of anything larger overflows in the second moment, which then stands still for ever."""

_ROWS_AT_ONCE = 100_000
"""So many rows at a time are stepped on the GPU: what lies between takes five times their room."""


def step_rows(
    values: torch.Tensor,
    first: torch.Tensor,
    second: torch.Tensor,
    seen: torch.Tensor,
    gradients: torch.Tensor,
    rates: np.ndarray,
    correction1: float,
    correction2: float,
    usable: torch.Tensor | None = None,
) -> torch.Tensor:
    """In place: values, first and second moments (N, D); seen (n,) int64 rows, each once; gradients (n, D); rates (D,)
    float32.

    correction1 = 1 - BETA1**t and correction2 = 1 - BETA2**t for the step count t. A row whose gradient is not finite,
    or beyond LARGEST_GRADIENT, is left alone; returns how many such rows there were, () int64. usable (n,) bool, on the
    GPU alone: the others are left alone, too, and not counted.
    """
    if not device.on_gpu(values):
        arrays = (t.numpy() for t in (values, first, second, seen, gradients))
        return torch.tensor(_step_rows(*arrays, rates, correction1, correction2))
    bad = torch.zeros((), dtype=torch.int64, device=values.device)
    steps = device.upload(rates, values)
    for start in range(0, len(seen), _ROWS_AT_ONCE):
        part = slice(start, start + _ROWS_AT_ONCE)
        bad += _step_rows_on_gpu(
            values, first, second, seen[part], gradients[part], steps, correction1, correction2,
            None if usable is None else usable[part],
        )  # fmt: skip
    return bad


def _step_rows_on_gpu(values, first, second, seen, gradients, rates, correction1, correction2, usable):
    finite = gradients.abs().amax(1) < LARGEST_GRADIENT
    counted = torch.ones_like(finite) if usable is None else usable
    stepped = (finite & counted)[:, None]
    old_value, old_first, old_second = values[seen], first[seen], second[seen]
    m = torch.lerp(gradients, old_first, BETA1)
    v = (BETA2 * old_second).addcmul_(gradients, gradients, value=1 - BETA2)
    change = (m / correction1).div_((v / correction2).sqrt_().add_(EPSILON)).mul_(rates)
    values.index_copy_(0, seen, torch.where(stepped, old_value - change, old_value))
    first.index_copy_(0, seen, torch.where(stepped, m, old_first))
    second.index_copy_(0, seen, torch.where(stepped, v, old_second))
    return (counted & ~finite).sum()


@kernel(parallel=True)
def _step_rows(values, first, second, seen, gradients, rates, correction1, correction2):
    bad = np.zeros(seen.size, np.int64)
    b1, b2 = np.float32(BETA1), np.float32(BETA2)
    one, largest = np.float32(1.0), np.float32(LARGEST_GRADIENT)
    c1 = np.float32(1.0 / correction1)
    c2 = np.float32(1.0 / correction2)
    for i in prange(seen.size):
        row = seen[i]
        usable = True
        for j in range(values.shape[1]):
            # Written so that NaN fails.
            usable &= abs(gradients[i, j]) < largest
        if not usable:
            bad[i] = 1
            continue
        for j in range(values.shape[1]):
            g = gradients[i, j]
            m = b1 * first[row, j] + (one - b1) * g
            v = b2 * second[row, j] + (one - b2) * g * g
            first[row, j] = m
            second[row, j] = v
            values[row, j] -= rates[j] * (m * c1) / (np.sqrt(v * c2) + np.float32(EPSILON))
    return bad.sum()


def take_rows(values: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
    """values[seen], the rows (n, D) of values (N, D) that a step works on; seen (n,) int64."""
    return values[seen] if device.on_gpu(values) else torch.from_numpy(_take_rows(values.numpy(), seen.numpy()))


@kernel(parallel=True)
def _take_rows(values, seen):
    out = np.empty((seen.size, values.shape[1]), values.dtype)
    for i in prange(seen.size):
        row = seen[i]
        for j in range(values.shape[1]):
            out[i, j] = values[row, j]
    return out
