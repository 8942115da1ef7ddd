"""The kernels of the GPU renderer, with the constants of the Python modules."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from types import ModuleType
from typing import Any

from ...gpu.kernel import Kernel
from ...shared.splats import spherical_harmonics
from .. import discs, settings, splats

TILE = 16
"""Width and height of a tile in pixels; a block of THREADS draws one, with one thread per pixel."""
THREADS = TILE * TILE
STAGED, STAGED_BACKWARD, STAGED_IDS = 256, 64, 64
"""Numbers of splats staged in shared memory at a time: in blending, in its gradient, and in the ranking of IDs."""
SLOTS = 32
"""Number of objects whose probabilities a pass of the ranking of IDs sums up."""
SPLATS_PER_BLOCK, _COLUMNS_ABREAST = 128, 16
"""Number of splats that a block of the projection's gradient processes, and of threads that sum a row's columns."""

_COLUMNS = {
    splats: "U V SLOPE A C LOP RED GREEN BLUE DEPTH HALF_W HALF_H SPLAT_COLUMNS "
    "M0 MY MYY MX MXY MXX G_RED G_GREEN G_BLUE G_DEPTH MQ MQX MQY MSX MSY G_NORMAL",
    discs: "Q0 QX QY NEAREST SPOT_U MIDDLE NORMAL_X NORMAL_Y NORMAL_Z TILT_COLUMNS",
}
_NUMBERS = {
    splats: "MAX_COLOR",
    discs: "SPOT",
    settings: "ALPHA_MAX ALPHA_MIN EPS_2D_DISC MAX_EXTENT MIN_DISC_WIDTH MIN_QUAT_NORM2 TRANSMITTANCE_THRESHOLD",
}


def _values_of(names: Mapping[ModuleType, str]) -> dict[str, Any]:
    """Return the constants with these names."""
    return {name: getattr(module, name) for module, listed in names.items() for name in listed.split()}


def constants() -> dict[str, Any]:
    """Return the constants of all kernels of the renderer."""
    return {
        "columns": _values_of(_COLUMNS),
        **_values_of(_NUMBERS),
        **{f"SH_C{degree}": getattr(spherical_harmonics, f"C{degree}") for degree in (0, 1, 2, 20, 30, 31, 32, 33)},
        "LN2": math.log(2.0), "HALF_LOG2E": 0.5 / math.log(2.0), "LOG2_CUT": math.log2(settings.ALPHA_MIN),
        "TILE": TILE, "STAGED": STAGED, "STAGED_BACKWARD": STAGED_BACKWARD, "STAGED_IDS": STAGED_IDS, "SLOTS": SLOTS,
        "SPLATS_PER_BLOCK": SPLATS_PER_BLOCK, "COLUMNS_ABREAST": _COLUMNS_ABREAST,
    }  # fmt: skip


@functools.cache
def raster_kernel(name: str, **variant: Any) -> Kernel:
    """Return a kernel of the renderer.

    Args:
        name: its name, which is that of its file in `backend/gpu/source/raster/`.
        variant: constants of this variant, as for `Kernel`.
    """
    return Kernel(name, {**constants(), **variant})
