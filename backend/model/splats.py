"""Explicit Gaussians as plain arrays: what is exported, imported and shown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass
class Splats:
    """N Gaussians in world coordinates.

    means (N, 3) world units, float32 or float64; quats (N, 4) unit, w x y z, local to world; scales (N, 3) standard
    deviations > 0, world units, not their logarithms; opacities (N,) in (0, 1), not their logits; sh (N, K, 3) with
    K = (degree + 1)^2 coefficients of the real spherical harmonics for red, green, blue, where
    colour = max(0, basis(direction) . sh + 0.5); object_ids (N,) int64 in 0 .. 2^32 - 1, 0 = belongs to no object;
    invented (N,) bool: made up to close a hole, and seen in no photo (none where it is not given).
    """

    means: NDArray
    quats: NDArray
    scales: NDArray
    opacities: NDArray
    sh: NDArray
    object_ids: NDArray
    invented: NDArray = field(default_factory=lambda: np.zeros(0, bool))

    def __post_init__(self) -> None:
        n = len(self.means)
        if len(self.invented) == 0:
            self.invented = np.zeros(n, bool)
        shapes = {
            "means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,), "object_ids": (n,), "invented": (n,),
        }  # fmt: skip
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"splats: {name} has shape {getattr(self, name).shape}, expected {shape}")
        if self.sh.ndim != 3 or self.sh.shape[0] != n or self.sh.shape[2] != 3:
            raise ValueError(f"splats: sh has shape {self.sh.shape}, expected ({n}, K, 3)")
        if self.sh.shape[1] < 1 or math.isqrt(self.sh.shape[1]) ** 2 != self.sh.shape[1]:
            raise ValueError(f"splats: sh has {self.sh.shape[1]} coefficients, expected 1, 4, 9 or 16")
        self.object_ids = self.object_ids.astype(np.int64, copy=False)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics: 0 is one colour from everywhere."""
        return math.isqrt(self.sh.shape[1]) - 1

    @classmethod
    def empty(cls, degree: int = 0) -> Splats:
        """No splats, with room for spherical harmonics of `degree`."""
        return cls(
            means=np.zeros((0, 3), np.float32),
            quats=np.zeros((0, 4), np.float32),
            scales=np.zeros((0, 3), np.float32),
            opacities=np.zeros(0, np.float32),
            sh=np.zeros((0, (degree + 1) ** 2, 3), np.float32),
            object_ids=np.zeros(0, np.int64),
        )

    def select(self, mask: NDArray) -> Splats:
        """The splats that a boolean mask (N,) or an array of indices picks, in that order; a copy."""
        return Splats(
            self.means[mask],
            self.quats[mask],
            self.scales[mask],
            self.opacities[mask],
            self.sh[mask],
            self.object_ids[mask],
            self.invented[mask],
        )

    def with_degree(self, degree: int) -> Splats:
        """The same splats with higher bands of spherical harmonics cut off, or filled with zeros."""
        k = (degree + 1) ** 2
        sh = np.zeros((len(self), k, 3), self.sh.dtype)
        keep = min(k, self.sh.shape[1])
        sh[:, :keep] = self.sh[:, :keep]
        return Splats(self.means, self.quats, self.scales, self.opacities, sh, self.object_ids, self.invented)


def concatenate(parts: Sequence[Splats]) -> Splats:
    """All of `parts` in order; lower degrees are filled up to the highest one among them."""
    if not parts:
        return Splats.empty()
    degree = max(part.degree for part in parts)
    parts = [part if part.degree == degree else part.with_degree(degree) for part in parts]
    return Splats(
        np.concatenate([part.means for part in parts]),
        np.concatenate([part.quats for part in parts]),
        np.concatenate([part.scales for part in parts]),
        np.concatenate([part.opacities for part in parts]),
        np.concatenate([part.sh for part in parts]),
        np.concatenate([part.object_ids for part in parts]),
        np.concatenate([part.invented for part in parts]),
    )
