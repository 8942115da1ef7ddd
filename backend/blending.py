"""Guards shared by everything that blends splats, so that all of them draw the same picture.

Constants alone, so that Blender's own Python can import it.
"""

ALPHA_MAX = 0.99
"""No splat is more opaque than this, so that what lies behind keeps a gradient."""

ALPHA_MIN = 1.0 / 255.0
"""A splat's contribution to a pixel below this is dropped; it also bounds the splat's extent."""

STOP = 1.01e-4
"""A pixel takes no further splats once the light that reaches them falls below this. The splat that crosses
the limit is still drawn, so no combination of ALPHA_MAX and STOP can make an opaque splat vanish. A little above
(1 - ALPHA_MAX)^2, so that rounding does not decide whether a third splat is seen behind two opaque ones."""

BLUR = 0.3
"""Variance in square pixels added to every splat's footprint (low-pass filter of 3D Gaussian splatting)."""

MAX_EXTENT = 1e9
"""Splats that reach further than this from their centre, in pixels, are dropped: their scale ran away."""

NEAR = 0.01
"""Near plane, in scene units after normalisation."""

TAN_MARGIN = 0.3
"""How far beyond the field of view, as a share of its half width, the projection's Jacobian still follows."""

MIN_QUAT_NORM2 = 1e-8
"""Quaternions shorter than the square root of this have no direction; their splats are dropped."""
