"""The guards of `backend.blending` for the renderers, and what only they know."""

from ..blending import ALPHA_MAX, ALPHA_MIN, BLUR, MAX_EXTENT, MIN_QUAT_NORM2, NEAR, STOP, TAN_MARGIN

__all__ = ["ALPHA_MAX", "ALPHA_MIN", "BLUR", "MAX_EXTENT", "MIN_QUAT_NORM2", "NEAR", "STOP", "TAN_MARGIN"]

DISC_BLUR = 0.5
"""Variance in square pixels of the spot that a 2D splat is never smaller than (low-pass filter of 2D Gaussian
splatting)."""

MIN_DISC_WIDTH = 0.05
"""A 2D splat seen so nearly from its edge that its standard deviation is below this, in pixels, is its spot alone: a
line so thin would be hit by pixel centres or missed by chance, and its gradients have no bound."""

MAX_SH_COEFFICIENTS = 16
"""Spherical harmonics up to degree 3."""
