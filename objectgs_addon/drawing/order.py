# SPDX-License-Identifier: GPL-3.0-or-later
"""The order in which splats are drawn, from far to near, by a sort of 16-bit numbers: one pass a byte."""

import numpy as np


def back_to_front(depths: np.ndarray, near: float, orthographic: bool) -> np.ndarray:
    """Indices of the splats that are deeper than `near`, the deepest first. depths: (N,) float32.

    With perspective, two whose depths differ by less than about a ten-thousandth may come in the order they are given.
    """
    is_ahead = depths > near
    ahead = None if is_ahead.all() else np.flatnonzero(is_ahead)
    kept = depths if ahead is None else depths.take(ahead)
    if len(kept) == 0:
        return np.zeros(0, np.int64)
    if orthographic:
        least, most = float(kept.min()), float(kept.max())
        keys = ((most - kept) * (65535.0 / max(most - least, 1e-30))).astype(np.uint16)
    else:
        # Positive floats are ordered as their bits are, which are nearly their logarithms.
        bits = np.ascontiguousarray(kept, np.float32).view(np.uint32)
        least, most = int(bits.min()), int(bits.max())
        keys = ((most - bits) >> max(0, (most - least).bit_length() - 16)).astype(np.uint16)
    order = np.argsort(keys, kind="stable")
    return order if ahead is None else ahead.take(order)
