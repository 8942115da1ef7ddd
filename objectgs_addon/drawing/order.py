# SPDX-License-Identifier: GPL-3.0-or-later
"""Back-to-front sorting of splats with a radix sort of 16-bit keys."""

import numpy as np


def back_to_front(depths: np.ndarray, near: float, orthographic: bool) -> np.ndarray:
    """Sort splats by depth.

    In perspective, splats whose relative depths differ by less than about 1e-4 may keep their input order.

    Args:
        depths: (N,) float32.
        near: splats at or in front of this depth are left out.
        orthographic: quantize depths linearly instead of logarithmically.

    Returns:
        Indices of the splats, the deepest first.
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
        # The bits of positive floats sort like the floats and are nearly linear in their logarithms.
        bits = np.ascontiguousarray(kept, np.float32).view(np.uint32)
        least, most = int(bits.min()), int(bits.max())
        keys = ((most - bits) >> max(0, (most - least).bit_length() - 16)).astype(np.uint16)
    order = np.argsort(keys, kind="stable")
    return order if ahead is None else ahead.take(order)
