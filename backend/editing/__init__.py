"""What the user changed about objects, applied to splats."""

from .apply import Fill, apply_edits, fill_of, recoloured, transformed

__all__ = ["Fill", "apply_edits", "fill_of", "recoloured", "transformed"]
