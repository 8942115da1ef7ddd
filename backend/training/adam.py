"""Adam on the rows that a step saw, in one pass over memory.

A row that was not seen keeps its value and moments (Mallick et al. 2024, "Taming 3DGS"), so a step costs what is
visible, not what exists.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from ..raster.kernel import kernel

BETA1 = 0.9
BETA2 = 0.999
EPSILON = 1e-15


@kernel(parallel=True)
def step_rows(values, first, second, seen, gradients, rates, correction1, correction2):
    """In place: values, first and second moments (N, D); seen (n,) int64 rows; gradients (n, D); rates (D,) float32.

    correction1 = 1 - BETA1**t and correction2 = 1 - BETA2**t for the step count t. A row whose gradient is not finite
    is left alone; returns how many such rows there were.
    """
    bad = np.zeros(seen.size, np.int64)
    b1, b2 = np.float32(BETA1), np.float32(BETA2)
    one = np.float32(1.0)
    c1 = np.float32(1.0 / correction1)
    c2 = np.float32(1.0 / correction2)
    for i in prange(seen.size):
        row = seen[i]
        check = np.float32(0.0)
        for j in range(values.shape[1]):
            check += gradients[i, j] * np.float32(0.0)
        if check != 0.0:
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


@kernel(parallel=True)
def take_rows(values, seen):
    """values[seen], the rows (n, D) of values (N, D) that a step works on."""
    out = np.empty((seen.size, values.shape[1]), values.dtype)
    for i in prange(seen.size):
        row = seen[i]
        for j in range(values.shape[1]):
            out[i, j] = values[row, j]
    return out
