"""Import and export of splats in the formats of other programs."""

from .anchors import write_anchors
from .background import background_sphere
from .fit import agreement, fit_splats
from .ply import read_splats, splat_table, write_splats
from .splat import write_splat
from .spz import write_spz

__all__ = [
    "agreement", "background_sphere", "fit_splats", "read_splats", "splat_table", "write_anchors", "write_splat",
    "write_splats", "write_spz",
]  # fmt: skip
