"""Application of the user's edits of objects to splats."""

from .apply import Fill, apply_edits, compute_fill, recolored, transformed

__all__ = ["Fill", "apply_edits", "compute_fill", "recolored", "transformed"]
