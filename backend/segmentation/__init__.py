"""Segments of photos by models of the Segment Anything family, of which the user has a checkpoint."""

from .kept_encodings import KeptEncodings
from .photo_segments import PhotoSegments, is_checkpoint
from .segmenter import Encoded, Segmenter, fingerprint

__all__ = ["Encoded", "KeptEncodings", "PhotoSegments", "Segmenter", "fingerprint", "is_checkpoint"]
