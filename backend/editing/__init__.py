"""Application of the user's edits of objects and of single splats."""

from .apply import Fill, apply_edits, compute_fill, recolored, transformed
from .single_splats import apply_splat_edits

__all__ = ["Fill", "apply_edits", "apply_splat_edits", "compute_fill", "recolored", "transformed"]
