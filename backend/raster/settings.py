"""The blending constants of `backend.shared.splats.blending`, and constants used only by the renderers."""

from ..shared.splats.blending import (
    ALPHA_MAX,
    ALPHA_MIN,
    EPS_2D,
    MAX_EXTENT,
    MIN_QUAT_NORM2,
    NEAR,
    TAN_MARGIN,
    TRANSMITTANCE_THRESHOLD,
    USUAL_EPS_2D,
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
    "USUAL_EPS_2D",
]

EPS_2D_DISC = 0.2
"""Variance in square pixels of the smallest footprint (spot) of a disc (low-pass filter of 2D Gaussian splatting)."""

MIN_DISC_WIDTH = 0.05
"""Projected standard deviation in pixels below which only the spot of a disc is drawn, since such a thin line covers
pixel centers only by chance, and its gradients are unbounded."""

MAX_SH_COEFFICIENTS = 16
"""Number of coefficients of spherical harmonics of degree 3."""
