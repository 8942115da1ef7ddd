"""Recoloring an object: one affine map of colors, the same for splats, textures and what the viewport draws.

Colors are those of the photos, as they are encoded (sRGB), 0 .. 1: what splats' spherical harmonics hold and what
textures store. An affine map of them is one of the harmonics too, exactly and in every band, and a shader needs three
dot products for it. Standard library and NumPy only, so that Blender's own Python can import it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

LUMA = np.array([0.299, 0.587, 0.114])
"""How bright the encoded channels look (ITU-R BT.601)."""

MIDDLE = 0.5
DARKEST_MIDDLE = 0.05
"""An object darker than this is recolored as if it were as bright: black has no shading to keep."""


@dataclass(frozen=True)
class Recolor:
    """What the user asks of an object's colors, applied in this order; the defaults change nothing.

    replace: the color that takes the place of the object's own, by the share `amount` (0 .. 1): shading, which is how
    bright a place is beside `middle`, stays. middle: the luma of the object's average color. hue: turns of the color
    wheel, -0.5 .. 0.5; brightness stays. saturation: 0 gray .. 1 as it is .. 2. contrast: about `middle`. value: times
    this. tint: each channel times this.
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
        """From what `stored` wrote; ValueError or TypeError where a value makes no sense. Unknown names are skipped."""
        known = {field.name: values[field.name] for field in fields(cls) if field.name in values}
        for name, value in known.items():
            known[name] = _color(value) if name in ("replace", "tint") else float(value)
            if not np.isfinite(known[name]).all():
                raise ValueError(f"{name} is {value}")
        return cls(**known)

    def stored(self) -> dict[str, Any] | None:
        """As objects.json holds it: what differs from the defaults; None where nothing is changed."""
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
        """Whether any color comes out another."""
        matrix, offset = self.affine()
        return not (np.allclose(matrix, np.eye(3), atol=1e-7) and np.allclose(offset, 0.0, atol=1e-7))

    def affine(self) -> tuple[np.ndarray, np.ndarray]:
        """matrix (3, 3) and offset (3,) in float64: new color = matrix @ color + offset."""
        gray = np.outer(np.ones(3), LUMA)
        shaded = np.outer(np.array(self.replace), LUMA) / max(self.middle, DARKEST_MIDDLE)
        matrix = (1.0 - self.amount) * np.eye(3) + self.amount * shaded
        matrix = gray @ matrix + self.saturation * (_turned(self.hue) @ (matrix - gray @ matrix))
        offset = np.full(3, (1.0 - self.contrast) * self.middle)
        scale = self.value * np.array(self.tint)
        return scale[:, None] * (self.contrast * matrix), scale * offset


def average_luma(colors: np.ndarray, weights: np.ndarray) -> float:
    """The luma of an object's average color, 0 .. 1, by which recoloring keeps its shading.

    colors (n, 3): of its splats, encoded; weights (n,): their opacities. `MIDDLE` where there is nothing to see.
    """
    if not np.sum(weights) > 0.0:
        return MIDDLE
    return float(np.average(np.clip(colors, 0.0, 1.0) @ LUMA, weights=weights))


def _turned(turns: float) -> np.ndarray:
    """(3, 3): colors turned around the gray axis; what has no luma keeps none."""
    angle = 2.0 * math.pi * turns
    axis = np.full(3, 1.0 / math.sqrt(3.0))
    across = np.array([[0.0, -1.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]]) / math.sqrt(3.0)
    turn = math.cos(angle) * np.eye(3) + math.sin(angle) * across + (1.0 - math.cos(angle)) * np.outer(axis, axis)
    # Along gray, so that brightness stays as it was.
    return turn - np.outer(np.ones(3), LUMA @ turn - LUMA @ np.eye(3))


def _color(value: Any) -> tuple[float, float, float]:
    red, green, blue = (float(channel) for channel in value)
    return red, green, blue
