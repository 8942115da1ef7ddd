"""The part of a model that a training changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

Bounds = tuple[tuple[float, float, float], tuple[float, float, float]]

EVERYWHERE: Bounds = ((-np.inf,) * 3, (np.inf,) * 3)


@dataclass(frozen=True)
class Region:
    """The part of a model that a training changes; the default is all of it.

    Attributes:
        fixed: number of anchors, the first of the model, that are drawn, but neither changed nor removed, and from
            which none grow.
        bounds: lower and upper corner, in scene units, of the box in which anchors may be added; infinite where it has
            no end. The lower faces belong to it.

    Unless the region is the whole model, the heads, the background and the corrections of the photos' colors are not
    changed either, since other regions share them.
    """

    fixed: int = 0
    bounds: Bounds = EVERYWHERE

    @property
    def is_whole(self) -> bool:
        """Whether the whole model is trained."""
        return self.fixed == 0 and self.bounds == EVERYWHERE

    def contains(self, positions: np.ndarray) -> np.ndarray:
        """Return which of the positions (n, 3) in scene units lie in the bounds: (n,) bool."""
        return inside(positions, self.bounds)

    def as_dict(self) -> dict[str, Any]:
        """Return the region as JSON, with None for infinite bounds."""
        return {
            "fixed": self.fixed,
            "bounds": [[x if np.isfinite(x) else None for x in corner] for corner in self.bounds],
        }

    @classmethod
    def of(cls, state: Mapping[str, Any]) -> Region:
        """Return the region in the state of a checkpoint; raises ValueError, TypeError or KeyError if it is damaged."""
        stored = state.get("region")
        return cls() if stored is None else cls(_count(stored["fixed"]), bounds_of(stored["bounds"]))


def inside(positions: np.ndarray, bounds: Bounds) -> np.ndarray:
    """Return which of the positions (n, 3) lie in a box: (n,) bool; its lower faces belong to it."""
    low, high = (np.array(corner) for corner in bounds)
    found = np.all((positions >= low) & (positions < high), axis=1)
    return found


def bounds_of(stored: Any) -> Bounds:
    """Return the bounds in JSON; raises ValueError or TypeError if they are none."""
    low, high = (
        [default if x is None else float(x) for x in corner]
        for corner, default in zip(stored, (-np.inf, np.inf), strict=True)
    )
    if len(low) != 3 or len(high) != 3 or not all(a <= b for a, b in zip(low, high, strict=True)):
        raise ValueError("a box is not valid")
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])


def _count(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError("a number of anchors is not valid")
    return value
