"""What the user changed about objects, applied to splats."""

from .apply import apply_edits, recoloured, transformed

__all__ = ["apply_edits", "recoloured", "transformed"]
