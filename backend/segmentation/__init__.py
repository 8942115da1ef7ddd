"""Segments of photos by models of the Segment Anything family, of which the user has a checkpoint."""

from . import finders
from .kept_encodings import KeptEncodings
from .photo_segments import Finder, PhotoSegments, chosen_checkpoint, is_checkpoint
from .sam3 import is_sam3
from .segmenter import Encoded, Segmenter, fingerprint

__all__ = [
    "Encoded",
    "Finder",
    "KeptEncodings",
    "PhotoSegments",
    "Segmenter",
    "chosen_checkpoint",
    "finders",
    "fingerprint",
    "is_checkpoint",
    "is_sam3",
]
