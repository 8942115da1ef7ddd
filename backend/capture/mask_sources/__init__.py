"""Masks of other programs, read as segments of each photo."""

from .images import MaskFiles, ids_of
from .open_source import open_source
from .segments import MaskSource, Segments

__all__ = ["MaskFiles", "MaskSource", "Segments", "ids_of", "open_source"]
