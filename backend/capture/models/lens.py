"""Lenses of other programs as COLMAP's camera models."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

_FIT_WITHIN = 0.5
"""Largest difference in pixels between a lens and the nearest one that COLMAP's models can represent."""


@dataclass(frozen=True)
class Lens:
    """A COLMAP camera model, and its parameters in COLMAP's order."""

    model: str
    params: tuple[float, ...]


def radial(f: float, cx: float, cy: float, k1: float, k2: float) -> Lens:
    """Return a lens with one focal length and two radial coefficients, as Bundler has it; all in pixels but k1, k2."""
    if k2:
        return Lens("RADIAL", (f, cx, cy, k1, k2))
    return Lens("SIMPLE_RADIAL", (f, cx, cy, k1)) if k1 else Lens("SIMPLE_PINHOLE", (f, cx, cy))


def brown(
    focal: tuple[float, float],
    center: tuple[float, float],
    k: tuple[float, float, float, float],
    p: tuple[float, float],
    size: tuple[int, int],
) -> Lens:
    """Return a lens of Brown's model with up to four radial coefficients.

    Args:
        focal, center: Focal lengths and principal point in pixels, x and y.
        k: Coefficients of r^2, r^4, r^6 and r^8.
        p: Tangential coefficients in OpenCV's order: x' = ... + 2 p1 x y + p2 (r^2 + 2 x^2).
        size: Width and height of the image in pixels.

    Returns:
        The simplest model that represents the lens. COLMAP has no r^8, so the radial factor is replaced by a quotient
        of polynomials where k4 is not 0.

    Raises:
        ValueError: No quotient is within half a pixel of the radial factor.
    """
    k1, k2, k3, k4 = k
    if k4 and all(map(math.isfinite, (*focal, *center, *k, *p))):
        return Lens("FULL_OPENCV", (*focal, *center, *_quotient(k, p, focal, center, size)))
    if k3 or k4:
        return Lens("FULL_OPENCV", (*focal, *center, k1, k2, *p, k3, 0.0, 0.0, 0.0))
    if k1 or k2 or any(p):
        return Lens("OPENCV", (*focal, *center, k1, k2, *p))
    return Lens("PINHOLE", (*focal, *center))


def fisheye(
    focal: tuple[float, float],
    center: tuple[float, float],
    k: tuple[float, float, float, float],
    p: tuple[float, float] = (0.0, 0.0),
) -> Lens:
    """Return an equidistant fisheye lens; arguments as for `brown`, with the angle in place of r."""
    if any(p):
        return Lens("THIN_PRISM_FISHEYE", (*focal, *center, k[0], k[1], *p, k[2], k[3], 0.0, 0.0))
    return Lens("OPENCV_FISHEYE", (*focal, *center, *k))


def _quotient(
    k: tuple[float, float, float, float],
    p: tuple[float, float],
    focal: tuple[float, float],
    center: tuple[float, float],
    size: tuple[int, int],
) -> tuple[float, ...]:
    """Return k1, k2, p1, p2, k3 .. k6 of FULL_OPENCV, fitted to 1 + k1 s + k2 s^2 + k3 s^3 + k4 s^4 with s = r^2."""
    f = min(map(abs, focal))
    far = [max(center[axis], size[axis] - center[axis]) for axis in range(2)]
    if not f > 0 or not 0 < math.hypot(*far) / f < 100:
        raise ValueError("its focal length is impossible")
    edge = math.hypot(*far) / f
    r = np.linspace(0, 3 * edge, 3001)
    s = r * r
    factor = 1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3])))
    # Up to the image's corner or, where the distortion folds over before it, up to the fold.
    inside = (r * factor <= 1.02 * edge) & (np.diff(r * factor, append=np.inf) > 0)
    end = len(r) if inside.all() else int(np.argmin(inside))
    s, r, factor = s[1:end], r[1:end], factor[1:end]
    if len(s) < 10:
        raise ValueError("its distortion folds over at once")
    powers = np.stack([s, s**2, s**3], 1)
    unit = np.abs(powers).max(0)
    # Numerator = factor * denominator is linear in both; weights of r make the error one of pixels.
    columns = np.concatenate([powers / unit, -factor[:, None] * powers / unit], 1) * r[:, None]
    fitted = np.linalg.lstsq(columns, (factor - 1) * r, rcond=1e-12)[0] / np.tile(unit, 2)
    numerator, denominator = 1 + powers @ fitted[:3], 1 + powers @ fitted[3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.abs(numerator / denominator - factor).astype(np.float64) * r * f
    if not (np.isfinite(off).all() and off.max() <= _FIT_WITHIN):
        raise ValueError("its fourth radial coefficient is too large")
    a1, a2, a3, b1, b2, b3 = map(float, fitted)
    return a1, a2, *p, a3, b1, b2, b3
