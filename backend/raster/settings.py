"""The blending constants of `backend.shared.splats.blending`, and those that only the renderers need."""

from ..shared.splats.blending import (
    ALPHA_MAX,
    ALPHA_MIN,
    EPS_2D,
    MAX_EXTENT,
    MIN_QUAT_NORM2,
    NEAR,
    TAN_MARGIN,
    TRANSMITTANCE_THRESHOLD,
)

__all__ = [
    "ALPHA_MAX",
    "ALPHA_MIN",
    "EPS_2D",
    "MAX_EXTENT",
    "MIN_QUAT_NORM2",
    "NEAR",
    "TAN_MARGIN",
    "TRANSMITTANCE_THRESHOLD",
]

EPS_2D_DISC = 0.5
"""Variance in square pixels of the spot that a disc always covers (low-pass filter of 2D Gaussian splatting)."""

MIN_DISC_WIDTH = 0.05
"""A disc whose projected standard deviation is below this, in pixels, is drawn as its spot alone: whether so thin a
line meets a pixel center is chance, and its gradients are unbounded."""

MAX_SH_COEFFICIENTS = 16
"""Spherical harmonics up to degree 3."""
