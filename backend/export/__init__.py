"""Files that other programs read."""

from .anchors import write_anchors
from .fit import agreement, fit_splats
from .ply import read_splats, write_splats

__all__ = ["agreement", "fit_splats", "read_splats", "write_anchors", "write_splats"]
