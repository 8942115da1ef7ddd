"""Constants shared by everything that blends splats, so that all of it draws the same image."""

ALPHA_MAX = 0.99
"""Upper limit of alpha, so that splats behind keep a gradient."""

ALPHA_MIN = 1.0 / 255.0
"""Alpha below this is not drawn; this also bounds a splat's extent."""

TRANSMITTANCE_THRESHOLD = 1.01e-4
"""A pixel is complete once its transmittance falls below this. The splat that crosses the threshold is still drawn, so
no combination of ALPHA_MAX and the threshold can make an opaque splat disappear. The value is slightly above
(1 - ALPHA_MAX)^2, so that rounding does not decide whether a third splat is visible behind two opaque ones."""

EPS_2D = 0.05
"""Variance in square pixels added to the footprint of a splat of this program's models (low-pass filter).

It is about the least with which a small opaque splat is drawn at one pixel center at least, wherever it is.
"""

LEAST_EPS_2D, USUAL_EPS_2D = 1e-3, 0.3
"""The smallest that files may have, and that of 3D Gaussian splatting (Kerbl et al. 2023), with which splats of other
programs are trained, and with which they have to be drawn. The latter blurs edges that are sharp in photos, and splats
trained with it are too thick in smaller images, too thin in larger ones."""

MAX_EXTENT = 1e9
"""Splats that extend farther than this from their center, in pixels, are not drawn: their scale has diverged."""

NEAR = 0.01
"""Near plane, in scene units after normalization."""

TAN_MARGIN = 0.3
"""Margin around the field of view, as a fraction of its half width, beyond which the Jacobian is clamped."""

MIN_QUAT_NORM2 = 1e-8
"""Quaternions with a squared norm below this have no direction; their splats are not drawn."""
