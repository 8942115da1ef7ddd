"""Recoloring of an object by an affine map of its colors, the same for splats, textures and the viewport.

Colors are sRGB-encoded, 0 .. 1, as in photos, textures and the splats' spherical harmonics. An affine map of the colors
is exactly an affine map of the harmonics' coefficients in every band, and takes three dot products in a shader.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

LUMA = np.array([0.299, 0.587, 0.114])
"""Luma coefficients of the encoded channels (ITU-R BT.601)."""

MIDDLE = 0.5
DARKEST_MIDDLE = 0.05
"""Lower limit of `middle`, since a black object has no shading to preserve."""


@dataclass(frozen=True)
class Recolor:
    """Color changes of an object, applied in this order; the defaults change nothing.

    Attributes:
        replace: color that replaces the object's own; the shading, which is the luma relative to `middle`, is kept.
        amount: fraction of `replace`, 0 .. 1.
        hue: rotation of the hue in turns of the color wheel, -0.5 .. 0.5; the luma is kept.
        saturation: 0: gray, 1: unchanged, up to 2.
        contrast: factor about `middle`.
        value: factor.
        tint: factor of each channel.
        middle: luma of the object's average color.
    """

    replace: tuple[float, float, float] = (0.5, 0.5, 0.5)
    amount: float = 0.0
    hue: float = 0.0
    saturation: float = 1.0
    contrast: float = 1.0
    value: float = 1.0
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    middle: float = MIDDLE

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Recolor:
        """Create from the result of `stored`, ignoring unknown names; raise ValueError or TypeError if invalid."""
        known = {field.name: values[field.name] for field in fields(cls) if field.name in values}
        for name, value in known.items():
            known[name] = _color(value) if name in ("replace", "tint") else float(value)
            if not np.isfinite(known[name]).all():
                raise ValueError(f"{name} is {value}")
        return cls(**known)

    def stored(self) -> dict[str, Any] | None:
        """Return the values that differ from the defaults, for objects.json; None if no color changes."""
        if not self.changes:
            return None
        default = asdict(Recolor())
        return {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in asdict(self).items()
            if value != default[key]
        }

    @property
    def changes(self) -> bool:
        """Whether any color changes."""
        matrix, offset = self.affine()
        return not (np.allclose(matrix, np.eye(3), atol=1e-7) and np.allclose(offset, 0.0, atol=1e-7))

    def affine(self) -> tuple[np.ndarray, np.ndarray]:
        """Return matrix (3, 3) and offset (3,), float64, of the map: new color = matrix @ color + offset."""
        gray = np.outer(np.ones(3), LUMA)
        shaded = np.outer(np.array(self.replace), LUMA) / max(self.middle, DARKEST_MIDDLE)
        matrix = (1.0 - self.amount) * np.eye(3) + self.amount * shaded
        matrix = gray @ matrix + self.saturation * (_turned(self.hue) @ (matrix - gray @ matrix))
        offset = np.full(3, (1.0 - self.contrast) * self.middle)
        scale = self.value * np.array(self.tint)
        return scale[:, None] * (self.contrast * matrix), scale * offset


def average_luma(colors: np.ndarray, weights: np.ndarray) -> float:
    """Compute the luma of an object's average color; recoloring keeps the shading relative to it.

    Args:
        colors: sRGB-encoded colors (n, 3) of the object's splats.
        weights: their opacities (n,).

    Returns:
        The luma, 0 .. 1; `MIDDLE` if the weights sum to 0.
    """
    if not np.sum(weights) > 0.0:
        return MIDDLE
    return float(np.average(np.clip(colors, 0.0, 1.0) @ LUMA, weights=weights))


def _turned(turns: float) -> np.ndarray:
    """Return the matrix (3, 3) that rotates colors about the gray axis by full `turns` and keeps their luma."""
    angle = 2.0 * math.pi * turns
    axis = np.full(3, 1.0 / math.sqrt(3.0))
    across = np.array([[0.0, -1.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]]) / math.sqrt(3.0)
    turn = math.cos(angle) * np.eye(3) + math.sin(angle) * across + (1.0 - math.cos(angle)) * np.outer(axis, axis)
    # Shift along the gray axis to restore the luma.
    return turn - np.outer(np.ones(3), LUMA @ turn - LUMA @ np.eye(3))


def _color(value: Any) -> tuple[float, float, float]:
    red, green, blue = (float(channel) for channel in value)
    return red, green, blue
